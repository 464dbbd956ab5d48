#include "explorer_step.h"

constexpr int BATCH = 64;  // runs

// The texels of a layout that an agent has not seen yet. If `bins`, adds them there, too.
static int count_left(const ExplorerStepParams& p, int agent, const Range& runs, const Pose& pose,
                      int* bins) {
    const unsigned int* seen = seen_by(p, agent);
    unsigned int last = p.n_words - 1;
    int n_left = 0;
    for (int first = runs.first; first < runs.end; first += BATCH) {
        int n = mini(BATCH, runs.end - first), counts[BATCH], bin[BATCH];
        const float* places = p.runs + 4 * (long long)first;
        const unsigned int* words = (const unsigned int*)places;
#pragma omp simd reduction(+ : n_left)
        for (int i = 0; i < n; i++) {
            counts[i] = unseen_of(words[4 * i + 2], words[4 * i + 3], seen, last);
            n_left += counts[i];
        }
        if (!bins)
            continue;
#pragma omp simd
        for (int i = 0; i < n; i++)
            bin[i] = bin_of(pose, places[4 * i], places[4 * i + 1]);
        for (int i = 0; i < n; i++)
            bins[bin[i]] += counts[i];
    }
    return n_left;
}

static void step_agent(const ExplorerStepParams& p, int agent) {
    int env = agent / p.scenery.n_agents;
    Episode episode = next(p, read_episode(p, agent));
    write_episode(p, episode, agent);
    if (p.metrics)
        p.metrics[agent] = 0.f;
    if (!p.unseen && !(p.metrics && is_over(episode)))
        return;
    int layout = layout_of(p.scenery, env, p.error_flag), bins[BINS] = {0};
    Pose pose = {0.f, 0.f, 0.f, 1.f};
    if (p.unseen)
        pose = pose_of(p, agent, env);
    int n_left = count_left(p, agent, runs_of(p, layout), pose, p.unseen ? bins : 0);
    if (p.metrics)
        write_coverage(p, episode, agent, layout, n_left);
    if (!p.unseen)
        return;
    for (int k = 0; k < N_EPISODE; k++)
        p.episode[N_EPISODE * (long long)agent + k] = episode_number(p, episode, n_left, k);
#pragma omp simd
    for (int k = 0; k < BINS; k++)
        p.unseen[BINS * (long long)agent + k] = unseen_number(p, bins[k]);
}

KERNEL explorer_step(const ExplorerStepParams& p) {
    const SceneryParams& s = p.scenery;
#pragma omp parallel for schedule(static) num_threads(s.n_threads)
    for (int agent = 0; agent < s.n_envs * s.n_agents; agent++)
        if (takes_part(p, agent))
            step_agent(p, agent);
}
