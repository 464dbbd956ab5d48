// Who stands in the middle of another's view is hit: health, rewards, and when episodes begin and
// end. An agent on its first observation neither hits nor is hit.
#pragma once
#include "errors.h"
#include "params.h"

constexpr int MAX_AGENTS = 16;
constexpr float SPENT = 1e-4f;  // of health: as much is rounding, and counts as none

// A step of an environment's agents, by agent.
struct Shots {
    int target[MAX_AGENTS];  // whom it hits; -1: nobody
    int wounds[MAX_AGENTS];  // how many hit it
    float loss[MAX_AGENTS];  // health that these take
    int dies[MAX_AGENTS];
};

// The agent in the middle of agent a's view, if both are past their first observation; else -1.
HD int target_of(const ShootParams& p, int first, int a) {
    int line = p.centre_line[first + a];
    if (line < 0 || line >= p.n_agents * p.n_model || p.ended[first + a])
        return -1;
    int target = line / p.n_model;
    return p.ended[first + target] ? -1 : target;
}

HD void aim_all(const ShootParams& p, int first, Shots& shots) {
    for (int a = 0; a < p.n_agents; a++)
        shots.wounds[a] = 0;
    for (int a = 0; a < p.n_agents; a++) {
        shots.target[a] = target_of(p, first, a);
        if (shots.target[a] >= 0)
            shots.wounds[shots.target[a]]++;
    }
}

// Agent a loses health to wounds and the drain. What is left, if any, recovers.
HD void wound(const ShootParams& p, int first, int a, Shots& shots) {
    float health = p.ended[first + a] ? 1.f : p.health[first + a];
    float wounds = (float)shots.wounds[a] * p.damage;
    shots.loss[a] = minf(wounds, health);
    float left = p.ended[first + a] ? 1.f : health - wounds - p.drain;
    shots.dies[a] = left <= SPENT;
    float gain = shots.target[a] >= 0 ? p.spoils : 0.f;
    if (!shots.wounds[a])
        gain = gain + p.recovery;
    p.health[first + a] = shots.dies[a] ? 0.f : minf(left + gain, 1.f);
}

// How near to the middle of its view agent i has another: 1 there, 0 at the edge or if there is
// none.
HD float aim_of(const ShootParams& p, int i) {
    if (!p.agent_ray || p.agent_ray[i] < 0)
        return 0.f;
    float half = 0.5f * (float)p.res, off = (float)p.agent_ray[i] - (float)(p.res / 2);
    return maxf(1.f - maxf(off, -off) / half, 0.f);
}

// What an episode comes to so far, and its metrics where it ends.
HD void count(const ShootParams& p, int i, float kills, float damage, float hit, int ends,
              int dies) {
    long long n = (long long)p.n_envs * p.n_agents;
    float values[3] = {kills, damage, hit};
    for (int k = 0; k < 3; k++) {
        float total = p.reset[i] ? 0.f : p.tally[k * n + i] + values[k];
        p.tally[k * n + i] = total;
        values[k] = ends ? total : 0.f;
    }
    p.metrics[i] = values[0];
    p.metrics[n + i] = ends && dies ? 1.f : 0.f;
    p.metrics[2 * n + i] = values[1];
    p.metrics[3 * n + i] = ends ? values[2] / (float)p.ages[i] : 0.f;
}

// Rewards agent a, of which the others' shots are known, and ends its episode if it must.
HD void judge(const ShootParams& p, int first, int a, const Shots& shots) {
    int i = first + a, target = shots.target[a], reset = p.ended[i];
    float hit = 0.f, kill = 0.f, damage = 0.f;
    if (target >= 0) {
        float share = 1.f / (float)shots.wounds[target];  // of those who hit the same
        hit = 1.f;
        kill = shots.dies[target] ? share : 0.f;
        damage = shots.loss[target] * share;
    }
    int dies = shots.dies[a], age = reset ? 0 : p.ages[i] + 1;
    int ends = !reset && (dies || age >= p.limit);
    float wounds = (float)shots.wounds[a];
    float reward = p.hit_reward * hit - p.wound_cost * wounds + p.kill_reward * kill -
                   p.death_cost * (float)dies + p.aim_reward * aim_of(p, i);
    p.reward[i] = reset ? 0.f : reward;
    p.reset[i] = (unsigned char)reset;
    p.terminal[i] = (unsigned char)(ends && dies);
    p.truncated[i] = (unsigned char)(ends && !dies);
    p.ended[i] = (unsigned char)ends;
    p.ages[i] = age;
    count(p, i, kill, damage, hit, ends, dies);
    unsigned short* vitals = p.vitals + 3 * (long long)i;
    vitals[0] = HALF_BITS(p.health[i]);
    vitals[1] = HALF_BITS(hit);
    vitals[2] = HALF_BITS(wounds);
}

// Own health; then of each other agent, the next one first: its health, where it stands, ahead and
// left in tens of metres, and which way it looks, as cosine and sine.
HD void tell(const ShootParams& p, int first, int a) {
    int n = p.n_agents, i = first + a;
    float* told = p.told + (1 + 5 * (n - 1)) * (long long)i;
    Pose own = pose_at(p.positions[2 * i], p.positions[2 * i + 1], p.angles[i]);
    *told++ = p.health[i];
    for (int k = 1; k < n; k++) {
        int j = first + (a + k) % n;
        float dx = p.positions[2 * j] - own.x, dy = p.positions[2 * j + 1] - own.y;
        float sine, cosine;
        sincos_degrees(p.angles[j], sine, cosine);
        *told++ = p.health[j];
        *told++ = (own.cosine * dx + own.sine * dy) * 0.1f;
        *told++ = (own.cosine * dy - own.sine * dx) * 0.1f;
        *told++ = own.cosine * cosine + own.sine * sine;
        *told++ = own.cosine * sine - own.sine * cosine;
    }
}

HD void shoot_env(const ShootParams& p, int env) {
    int first = env * p.n_agents;
    Shots shots;
    aim_all(p, first, shots);
    for (int a = 0; a < p.n_agents; a++)
        wound(p, first, a, shots);
    for (int a = 0; a < p.n_agents; a++)
        judge(p, first, a, shots);
    if (p.told)
        for (int a = 0; a < p.n_agents; a++)
            tell(p, first, a);
}
