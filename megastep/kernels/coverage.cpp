// A loop over agents.
#include "coverage.h"

KERNEL coverage(const CoverageParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++) {
        int n_seen = 0, n_visible = 0;
        if (p.mask[agent]) {
            int layout = layout_of(s, agent / s.n_agents, p.error_flag);
            const unsigned int* seen = p.seen + agent * (long long)p.n_words;
            const unsigned int* visible = p.visible + layout * (long long)p.n_words;
            for (int i = 0; i < p.n_words; i++)
                count_covered(seen[i], visible[i], n_seen, n_visible);
        }
        p.coverage[agent] = fraction_of(n_seen, n_visible);
    }
}
