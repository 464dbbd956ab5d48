// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

constexpr int GROUP = 8;       // walls that share a bounding box in searches for shortest paths
constexpr int KEPT = 16;       // links of a corner that need not be searched for twice
constexpr int MAX_GOALS = 16;  // per home, in one search

// Homes, and the points where shortest paths may bend: D homes, K groups of walls, V corners, G
// goals per home. See shortest_paths.h.
struct HomesParams {
    const float* walls;        // (4, GROUP K) x and y of one end, then of the other
    const float* boxes;        // (4, K) bounds of each group: low x, low y, high x, high y
    const int* group_starts;   // (D + 1) first group of each home
    const float* corners;      // (6, V) x and y, then the normals of the two sides that meet there
    const int* corner_starts;  // (D + 1) first corner of each home
    int n_groups;
    int n_corners;
    int n_homes;
    int n_threads;    // on the CPU
    float clearance;  // metres that paths keep from walls
    float rebate;     // metres by which the way around a corner is shorter than the polygon's
};

struct ClearancesParams {
    HomesParams homes;
    const float* points;    // (P, 2)
    const int* home_index;  // (P) the home that each point is in
    float* clearances;      // (P) out: metres to the nearest wall
    float most;             // metres: no clearance is more
    int n_points;
};

struct CornerLinksParams {
    HomesParams homes;
    const int* corner_homes;  // (V) the home of each corner
    const int* starts;        // (V + 1) first link of each corner; null: the links are only counted
    int* counts;              // (V) out, if they are counted, as is the next: links of each corner
    int* kept;                // (V, KEPT) the first links of each corner; read if links are written
    int* targets;             // (links) out: the corner at the other end
    float* metres;            // (links) out
};

struct CornerDistancesParams {
    HomesParams homes;
    const int* starts;    // (V + 1), as above
    const int* targets;   // (links)
    const float* metres;  // (links)
    const float* goals;   // (D, G, 2)
    float* distances;     // (V, MAX_GOALS) out: metres from each corner to each goal
    int n_goals;          // G
};

struct PathLengthsParams {
    HomesParams homes;
    const float* goals;       // (D, G, 2)
    const float* distances;   // (V, MAX_GOALS)
    const float* points;      // (P, 2), those of one home after the other; null: cells of grids
    const int* widths;        // (D) columns of each home's grid, or 1
    const int* point_starts;  // (D + 1) first point of each home
    float* lengths;           // out: per home (G, points of the home): metres to each goal
    float cell;               // metres between neighbouring cells
    int n_points;             // P
    int n_goals;              // G
};
