#!/usr/bin/env bash
# networkx 3.6.1: `shortest_path`, `shortest_path_length`, `diameter` and `eccentricity` take every edge for 1, also
# where edges have the attribute "weight", which `astar_path` and `dijkstra_path` read by default. An unknown name,
# such as weight="metres" where edges have "meters", is no error: each edge counts 1 again.
# Seen, a door of 10 m against a way round of 1 + 1 m: shortest_path takes the door, A* the way round.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q networkx==3.6.1
"$folder/bin/python" -W ignore - <<'END'
import networkx as nx

rooms = nx.Graph()
rooms.add_weighted_edges_from([("a", "b", 10.0), ("a", "c", 1.0), ("c", "b", 1.0)])
shortest, astar = nx.shortest_path(rooms, "a", "b"), nx.astar_path(rooms, "a", "b")
lengths = [
    nx.shortest_path_length(rooms, "a", "b"),
    nx.shortest_path_length(rooms, "a", "b", weight="weigth"),
    nx.astar_path_length(rooms, "a", "b"),
]
print("shortest_path:", shortest, "astar_path:", astar, "lengths, the second misspelt:", lengths)
assert (shortest, astar) == (["a", "b"], ["a", "c", "b"])
assert lengths == [1, 1, 2.0] and nx.diameter(rooms) == 1
END
