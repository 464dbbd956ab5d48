// Operations with a thread per point or per corner.
#include "shortest_paths.h"

EACH(clearances, ClearancesParams, p.n_points, p.homes.n_threads,
     p.clearances[i] = nearest_wall(p, i))

EACH(corner_links, CornerLinksParams, p.homes.n_corners, p.homes.n_threads,
     p.starts ? write_links(p, i) : count_links(p, i))

EACH(path_lengths, PathLengthsParams, p.n_points, p.homes.n_threads, point_lengths(p, i))
