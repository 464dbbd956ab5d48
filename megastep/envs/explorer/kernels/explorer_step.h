// One step of Explorer: where episodes start and end, rewards, the fraction of the home that was
// seen, and what a critic sees: counts of the visible texels that are still unseen, in bins around
// the agent.
#pragma once
#include "common/step.h"

constexpr int BANDS = 3;      // of distance: up to 1.5 m, up to 4 m, beyond
constexpr int SECTORS = 16;   // of bearing
constexpr int N_EPISODE = 4;  // numbers that a critic sees of an episode

// N environments, A agents per environment, D layouts, S runs of texels of all layouts together.
struct ExplorerStepParams : GameParams {
    const int* newly_seen;     // (N, A) texels newly marked in seen
    const unsigned int* seen;  // (N, A, n_words) a bit per static texel
    const float* runs;         // (S, 4) see Run below; null: nothing is counted
    const int* run_starts;     // (D + 1) first run of each layout
    const int* n_visible;      // (D) visible texels of each layout
    int* limits;               // (N, A) in and out: age at which the episode is truncated
    float* episode;            // (N, A, N_EPISODE) steps left and taken, texels seen and left
    float* unseen;             // (N, A, BINS) null: none, and no episode
    int n_words;
    int n_runs;              // S
    int patience;            // steps that an episode lasts beside one per texel seen
    float points_per_texel;  // reward for a texel seen for the first time
};

// Visible texels of one wall that share a word of bits, at most 1.6 m. They are all counted at the
// run's midpoint.
struct ALIGNED Run {
    float x, y;
    unsigned int word, bits;
};

HD Range runs_of(const ExplorerStepParams& p, int layout) {
    return range_of(p.run_starts, layout, p.n_runs);
}

// The texels of a run that an agent has not seen yet, of whose words `last` is the last.
HD int unseen_of(unsigned int word, unsigned int bits, const unsigned int* seen,
                 unsigned int last) {
    return COUNT_BITS(bits & ~seen[word < last ? word : last]);
}

HD const unsigned int* seen_by(const ExplorerStepParams& p, int agent) {
    return p.seen + agent * (long long)p.n_words;
}

HD Pose pose_of(const ExplorerStepParams& p, int agent, int env) {
    float x = p.positions[2 * agent], y = p.positions[2 * agent + 1], angle = p.angles[agent];
    flag_nonfinite(p.error_flag, env, x, y, angle);
    return pose_at(x, y, angle);
}

// ---- Bins around an agent: sectors of bearing relative to its heading, bands of distance ----

constexpr int BINS = BANDS * SECTORS;
constexpr float BAND_ENDS[] = {1.5f, 4.f};  // metres

// Sector 0 is straight ahead, 4 to the left, 8 behind. Bearings are compared with the tangents of
// odd multiples of 11.25 degrees, which needs no arc tangent.
HD int sector_of(float ahead, float left) {
    float along = ABS(ahead), across = ABS(left);
    int sector = (across > 0.19891237f * along) + (across > 0.66817864f * along) +
                 (across > 1.49660576f * along) + (across > 5.02733949f * along);
    if (ahead < 0.f)
        sector = SECTORS / 2 - sector;
    return (left < 0.f ? -sector : sector) & (SECTORS - 1);
}

HD int band_of(float ahead, float left) {
    float squared = ahead * ahead + left * left;
    return (squared > BAND_ENDS[0] * BAND_ENDS[0]) + (squared > BAND_ENDS[1] * BAND_ENDS[1]);
}

HD int bin_of(const Pose& pose, float x, float y) {
    float dx = x - pose.x, dy = y - pose.y;
    float ahead = pose.cosine * dx + pose.sine * dy, left = pose.cosine * dy - pose.sine * dx;
    return SECTORS * band_of(ahead, left) + sector_of(ahead, left);
}

// ---- Episodes ----

struct Episode {
    int reset, newly_seen, age, limit;
};

HD Episode read_episode(const ExplorerStepParams& p, int agent) {
    return {begins(p, agent), p.newly_seen[agent], p.ages[agent], p.limits[agent]};
}

// The episode one step later. Each texel that is seen for the first time is worth another step.
HD Episode next(const ExplorerStepParams& p, const Episode& before) {
    Episode now = before;
    now.age = before.reset ? 0 : before.age + 1;
    now.limit = (before.reset ? p.patience : before.limit) + before.newly_seen;
    return now;
}

HD int is_over(const Episode& episode) { return episode.age >= episode.limit; }

HD void write_episode(const ExplorerStepParams& p, const Episode& episode, int agent) {
    float reward = episode.reset ? 0.f : (float)episode.newly_seen * p.points_per_texel;
    p.limits[agent] = episode.limit;
    write_outcome(p, agent, reward, episode.reset, episode.age, is_over(episode), 0);
}

// The fraction of the visible texels that an agent has seen, if its episode is over.
HD void write_coverage(const ExplorerStepParams& p, const Episode& episode, int agent, int layout,
                       int n_left) {
    int n = p.n_visible[layout];
    p.metrics[agent] = is_over(episode) ? (float)(n - n_left) / (float)maxi(n, 1) : 0.f;
}

// Number k of what a critic sees of an episode, scaled to about 1.
HD float episode_number(const ExplorerStepParams& p, const Episode& episode, int n_left, int k) {
    if (k == 0)
        return (float)(episode.limit - episode.age) / 200.f;
    return (float)(k == 1 ? episode.age : k == 2 ? episode.limit - p.patience : n_left) / 1000.f;
}

// A root or a division of 0 takes a GPU ten times as long.
HD float unseen_number(const ExplorerStepParams& p, int count) {
    return count ? SQRT((float)count * p.points_per_texel) : 0.f;
}
