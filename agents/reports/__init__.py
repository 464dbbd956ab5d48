"""Reports of runs: one page about a run or several, and plots that compare them."""
