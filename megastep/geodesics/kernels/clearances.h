// The distance from points to the nearest wall of their home.
#include "shortest_paths.h"

EACH(clearances, ClearancesParams, p.n_points, p.homes.n_threads,
     p.clearances[i] = nearest_wall(p, i))
