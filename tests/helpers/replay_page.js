// node replay_page.js PROGRAM.js PAGE.html STEPS.json: runs a page's program without a browser.
//
// STEPS is {modules: [file or null: the page's own], actions: [[action per lane and number], ...] or null, hashed:
// [index of a buffer], greedy: number of steps by the page's policies}. Prints one JSON per module: a hash of the
// buffers after the reset and each step, or the actions and logits of each step.
const { createHash } = require("crypto");
const { readFileSync } = require("fs");
const vm = require("vm");

const [program, page, steps] = process.argv.slice(2);
vm.runInThisContext(`${readFileSync(program)}\nglobalThis.parts = { unpacked, Simulation };`);
const { modules, actions, hashed, greedy } = JSON.parse(readFileSync(steps));
const [, text] = readFileSync(page, "utf8").match(/id="data">([^<]*)</);

async function main() {
  const unpacked = await globalThis.parts.unpacked(text);
  for (const file of modules) {
    const module = file ? await WebAssembly.compile(readFileSync(file)) : unpacked.module;
    const simulation = new globalThis.parts.Simulation({ ...unpacked, module });
    simulation.reset(simulation.data.seed);
    const hashes = [], taken = [], logits = [];
    const hash = () => {
      const state = createHash("sha256");
      for (const i of hashed) state.update(simulation.array([i], simulation.data.buffers[i][0], Uint8Array));
      hashes.push(state.digest("hex").slice(0, 16));
    };
    hash();
    for (const action of actions ?? []) {
      simulation.step(Object.fromEntries(action.entries()));
      hash();
    }
    for (const { section } of greedy ? simulation.data.policies : []) simulation.change(section, "greedy", () => 1);
    for (let t = 0; t < (greedy ?? 0); t++) {
      simulation.step({});
      const lanes = simulation.data.policies.flatMap(({ lanes: [a, b], logits: leaf }) => (
        Array.from({ length: b - a }, (_, lane) => simulation.leaf(leaf, lane))));
      logits.push(lanes);
      taken.push(lanes.map((_, lane) => simulation.leaf(simulation.data.actions, lane)));
    }
    console.log(JSON.stringify({ hashes, taken, logits }));
  }
}

main();
