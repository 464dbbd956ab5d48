// One step of Deathmatch: an agent hits whoever is at the centre of its view. Computes health,
// rewards, and where episodes start and end. An agent on its first observation neither hits nor is
// hit.
#pragma once
#include "params.h"

constexpr float MIN_HEALTH = 1e-4f;    // less is a rounding error and counts as 0
constexpr float MIN_DISTANCE = 1e-3f;  // metres; agents are never that near

// The hits of one step in one environment, by agent.
struct Hits {
    int target[MAX_AGENTS];  // the agent that it hits; -1: none
    int wounds[MAX_AGENTS];  // number of agents that hit it
    float loss[MAX_AGENTS];  // health lost to them
    int dies[MAX_AGENTS];
};

// The agent at the centre of agent a's view; -1 if there is none or one of the two starts an
// episode.
HD int target_of(const DeathmatchStepParams& p, int first, int a) {
    int line = p.centre_line[first + a];
    if (line < 0 || line >= p.n_agents * p.n_model || p.ended[first + a])
        return -1;
    int target = line / p.n_model;
    return p.ended[first + target] ? -1 : target;
}

HD void find_targets(const DeathmatchStepParams& p, int first, Hits& hits) {
    for (int a = 0; a < p.n_agents; a++)
        hits.wounds[a] = 0;
    for (int a = 0; a < p.n_agents; a++) {
        hits.target[a] = target_of(p, first, a);
        if (hits.target[a] >= 0)
            hits.wounds[hits.target[a]]++;
    }
}

// Updates agent a's health: wounds and drain first; an agent that survives then gains health.
HD void update_health(const DeathmatchStepParams& p, int first, int a, Hits& hits) {
    float health = p.ended[first + a] ? 1.f : p.health[first + a];
    float wounds = (float)hits.wounds[a] * p.damage;
    hits.loss[a] = minf(wounds, health);
    float left = p.ended[first + a] ? 1.f : health - wounds - p.drain;
    hits.dies[a] = left <= MIN_HEALTH;
    float gain = hits.target[a] >= 0 ? p.health_per_hit : 0.f;
    if (!hits.wounds[a])
        gain = gain + p.recovery;
    p.health[first + a] = hits.dies[a] ? 0.f : minf(left + gain, 1.f);
}

// How well agent i aims: 1 with another agent at the centre of its view, 0 at the edge or without
// one.
HD float aim_of(const DeathmatchStepParams& p, int i) {
    if (!p.agent_ray || p.agent_ray[i] < 0)
        return 0.f;
    float half = 0.5f * (float)p.res, off = (float)p.agent_ray[i] - (float)(p.res / 2);
    return maxf(1.f - maxf(off, -off) / half, 0.f);
}

// What agent i's aim gained since the last step, which it remembers for the next.
HD float gain_of_aim(const DeathmatchStepParams& p, int i) {
    float* last = p.tally + SUMS * (long long)p.n_envs * p.n_agents + i;
    float aim = aim_of(p, i), gain = aim - *last;
    *last = aim;
    return gain;
}

// Updates the sums of agent i's episode, and writes its metrics if the episode ends.
HD void update_tally(const DeathmatchStepParams& p, int i, float kills, float damage, float hit,
                     int ends, int dies) {
    long long n = (long long)p.n_envs * p.n_agents;
    float values[SUMS] = {kills, damage, hit};
    for (int k = 0; k < SUMS; k++) {
        float total = p.reset[i] ? 0.f : p.tally[k * n + i] + values[k];
        p.tally[k * n + i] = total;
        values[k] = ends ? total : 0.f;
    }
    p.metrics[i] = values[0];
    p.metrics[n + i] = ends && dies ? 1.f : 0.f;
    p.metrics[2 * n + i] = values[1];
    p.metrics[3 * n + i] = ends ? values[2] / (float)p.ages[i] : 0.f;
}

// Writes agent a's reward, flags and health observation once all hits of the step are known.
HD void finish_step(const DeathmatchStepParams& p, int first, int a, const Hits& hits) {
    int i = first + a, target = hits.target[a], reset = p.ended[i];
    float hit = 0.f, kill = 0.f, damage = 0.f;
    if (target >= 0) {
        float fraction = 1.f / (float)hits.wounds[target];  // among those who hit the same target
        hit = 1.f;
        kill = hits.dies[target] ? fraction : 0.f;
        damage = hits.loss[target] * fraction;
    }
    int dies = hits.dies[a], age = reset ? 0 : p.ages[i] + 1;
    int ends = !reset && (dies || age >= p.limit);
    float wounds = (float)hits.wounds[a];
    float reward = *p.hit_reward * hit - *p.wound_cost * wounds + *p.kill_reward * kill -
                   *p.death_cost * (float)dies + *p.aim_reward * gain_of_aim(p, i);
    if (p.newly_seen)
        reward += (float)p.newly_seen[i] * p.search_reward;
    write_outcome(p, i, reset ? 0.f : reward, reset, ends, dies);
    p.ended[i] = (unsigned char)ends;
    p.ages[i] = age;
    update_tally(p, i, kill, damage, hit, ends, dies);
    unsigned short* health_obs = p.health_obs + 3 * (long long)i;
    health_obs[0] = HALF_BITS(p.health[i]);
    health_obs[1] = HALF_BITS(hit);
    health_obs[2] = HALF_BITS(wounds);
}

// Writes what agent a hears: the nearest other agent, through walls too. Loudness falls from 1 to 0
// at p.hearing metres.
HD void write_sound(const DeathmatchStepParams& p, int first, int a) {
    int i = first + a;
    float ahead = 0.f, left = 0.f, nearest = p.hearing;
    Pose pose = pose_at(p.positions[2 * i], p.positions[2 * i + 1], p.angles[i]);
    for (int j = first; j < first + p.n_agents; j++) {
        float dx = p.positions[2 * j] - pose.x, dy = p.positions[2 * j + 1] - pose.y;
        float distance = SQRT(dx * dx + dy * dy);
        if (j == i || !(distance < nearest))
            continue;
        nearest = distance;
        float scale = 1.f / maxf(distance, MIN_DISTANCE);
        ahead = (pose.cosine * dx + pose.sine * dy) * scale;
        left = (pose.cosine * dy - pose.sine * dx) * scale;
    }
    unsigned short* sound = p.sound + 3 * (long long)i;
    sound[0] = HALF_BITS(1.f - nearest / p.hearing);
    sound[1] = HALF_BITS(ahead);
    sound[2] = HALF_BITS(left);
}

// Writes what a critic sees of agent a: its health, then for each other agent, starting with the
// next one: its health, its position ahead and left in tens of metres, and the cosine and sine of
// its heading relative to a's.
HD void write_privileged(const DeathmatchStepParams& p, int first, int a) {
    int n = p.n_agents, i = first + a;
    float* out = p.privileged + (1 + PRIVILEGED_PER_OPPONENT * (n - 1)) * (long long)i;
    Pose pose = pose_at(p.positions[2 * i], p.positions[2 * i + 1], p.angles[i]);
    *out++ = p.health[i];
    for (int k = 1; k < n; k++) {
        int j = first + (a + k) % n;
        float dx = p.positions[2 * j] - pose.x, dy = p.positions[2 * j + 1] - pose.y;
        float sine, cosine;
        sincos_degrees(p.angles[j], sine, cosine);
        *out++ = p.health[j];
        *out++ = (pose.cosine * dx + pose.sine * dy) * 0.1f;
        *out++ = (pose.cosine * dy - pose.sine * dx) * 0.1f;
        *out++ = pose.cosine * cosine + pose.sine * sine;
        *out++ = pose.cosine * sine - pose.sine * cosine;
    }
}

// Counts a step of the round. At its end, ends the episodes of all agents, but not while one
// begins.
HD void end_round(const DeathmatchStepParams& p, int env) {
    int first = env * p.n_agents, is_over = ++p.round_ages[env] >= p.limit;
    long long n = (long long)p.n_envs * p.n_agents;
    for (int i = first; i < first + p.n_agents; i++)
        is_over = is_over && !p.reset[i];
    if (!is_over)
        return;
    p.round_ages[env] = -1;
    for (int i = first; i < first + p.n_agents; i++) {
        if (!p.ended[i]) {
            p.metrics[i] = p.tally[i];
            p.metrics[n + i] = 0.f;
            p.metrics[2 * n + i] = p.tally[n + i];
            p.metrics[3 * n + i] = p.tally[2 * n + i] / (float)p.ages[i];
            p.ended[i] = 1;
        }
        p.truncated[i] = !p.terminal[i];
    }
}

HD void deathmatch_env(const DeathmatchStepParams& p, int env) {
    int first = env * p.n_agents;
    Hits hits;
    find_targets(p, first, hits);
    for (int a = 0; a < p.n_agents; a++)
        update_health(p, first, a, hits);
    for (int a = 0; a < p.n_agents; a++)
        finish_step(p, first, a, hits);
    if (p.round_ages)
        end_round(p, env);
    for (int a = 0; a < p.n_agents; a++) {
        if (p.sound)
            write_sound(p, first, a);
        if (p.privileged)
            write_privileged(p, first, a);
    }
}

EACH(deathmatch_step, DeathmatchStepParams, p.n_envs, p.n_threads, deathmatch_env(p, i))

EACH(actions_of_live, ActionsOfLiveParams, p.n_lanes, 1, p.out[i] = p.ended[i] ? 0 : p.actions[i])
