"""Importers of floor plans: CubiCasa5k, HouseExpo, SVG drawings and maps of robots.

They need the extra `plans` (shapely, defusedxml, svgelements), and run in `megastep
import` alone: nothing that trains imports this package. `outlines` makes a geometry from polygons;
each other module reads one format. Files come from strangers: `safe` reads them.
"""
