// Plays a program of kernels in a page. The program is data: lists of launches, the memory that they
// read and write, and where in it the world lies. Nothing here knows how an environment works, only how
// to draw what some fields of kernels hold.
"use strict";

// ---- The program: kernels in WebAssembly, and the memory of one environment ----

const HALVES = Float32Array.from({ length: 65536 }, (_, bits) => {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023, sign = bits & 32768 ? -1 : 1;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : fraction / 2 ** 24);
});
const ARRAYS = {
  float16: Uint16Array, float32: Float32Array, uint8: Uint8Array, bool: Uint8Array, int32: Int32Array,
  int64: BigInt64Array,
};

// Returns the parts of a page's data: what JSON says, the compiled module, and the memory at the start.
async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const body = await new Response(stream).arrayBuffer();
  const [nData, nCode] = new Uint32Array(body, 0, 2), start = 12 + nData + nCode;
  const data = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 12, nData)));
  const module = await WebAssembly.compile(body.slice(12 + nData, start)), memory = body.slice(start);
  const contents = data.buffers.map(([size, at, packed]) => (packed !== 2 ? new Uint8Array(memory, at, packed && size)
    : new Uint8Array(Float32Array.from(new Uint16Array(memory, at, size / 4), bits => HALVES[bits]).buffer)));
  return { data, module, contents };
}

class Simulation {
  constructor({ data, module, contents }) {
    Object.assign(this, { data, contents, calls: {} });
    this.kernels = new WebAssembly.Instance(module, {}).exports;
    this.kernels._initialize();
    this.addresses = data.buffers.map(([size]) => this.reserve(size));
    for (const [name, launches] of Object.entries(data.sections)) {
      this.calls[name] = launches.map(launch => this.call(...launch));
    }
  }

  reserve(size) {
    return (this.kernels.malloc(size + 31) + 15) & ~15;
  }

  // A launch whose struct lies in memory: pointers and numbers are words of 4 bytes.
  call(operation, values) {
    const address = this.reserve(4 * values.length);
    const words = values.map(value => (Array.isArray(value) ? this.addresses[value[0]] + value[1] : value ?? 0));
    new Uint32Array(this.kernels.memory.buffer, address, words.length).set(words);
    return { operation, values, address, run: this.kernels[operation] };
  }

  run(section) {
    for (const { run, address } of this.calls[section]) run(address);
  }

  // Sets the word `name` of all launches of a section that have it, by a function of its first value.
  change(section, name, changed) {
    for (const { operation, values, address } of this.calls[section]) {
      const i = this.data.names[operation].indexOf(name);
      if (i >= 0) new Uint32Array(this.kernels.memory.buffer, address + 4 * i, 1)[0] = changed(values[i]);
    }
  }

  // Returns the word `name` of the first launch of a step that has it: a number, or [buffer, offset].
  word(name) {
    const at = ([operation, values]) => values[this.data.names[operation].indexOf(name)] ?? null;
    return this.data.sections.step.map(at).find(value => value !== null);
  }

  array([buffer, offset = 0], size, kind = Float32Array) {
    return new kind(this.kernels.memory.buffer, this.addresses[buffer] + offset, size);
  }

  // Returns numbers of the field `name` from its first on, or undefined.
  field(name, size, kind) {
    const pointer = this.word(name);
    return pointer && this.array(pointer, size, kind);
  }

  // Returns a lane's numbers of a leaf [buffer, offset, shape, strides, dtype].
  leaf([buffer, offset, shape, strides, dtype], lane) {
    const kind = ARRAYS[dtype], start = offset + lane * strides[0] * kind.BYTES_PER_ELEMENT;
    const indices = shape.slice(1).reduce((all, n, axis) => (
      all.flatMap(index => Array.from({ length: n }, (_, i) => index + i * strides[axis + 1]))), [0]);
    const numbers = this.array([buffer, start], Math.max(...indices) + 1, kind);
    return indices.map(i => (dtype === "float16" ? HALVES[numbers[i]] : Number(numbers[i])));
  }

  world(path, lane) {
    return this.leaf(this.data.world[path], lane);
  }

  get layout() {
    return this.field("scenery.layout", 1, Int32Array)?.[0] ?? 0;
  }

  // Begins anew, as the environment with this seed does, or in the home of the number `home`.
  reset(seed, home = null) {
    this.contents.forEach((bytes, i) => {
      const memory = this.array([i], this.data.buffers[i][0], Uint8Array);
      bytes.length ? memory.set(bytes) : memory.fill(0);
    });
    for (const section of Object.keys(this.calls)) {
      this.change(section, "key0", key => (key + seed - this.data.seed) >>> 0);
    }
    this.change("reset", "resample", resample => (home === null ? resample : 0));
    if (home !== null) this.field("scenery.layout", 1, Int32Array)[0] = home;
    this.run("reset");
    for (const [source, target] of this.data.copies) {
      const size = this.data.buffers[source][0];
      this.array([target], size, Uint8Array).set(this.array([source], size, Uint8Array));
    }
  }

  // Takes a step by the policies' actions, but those of the lanes in `given` {lane: action}.
  step(given) {
    for (const { section } of this.data.policies) this.run(section);
    const [buffer, offset, , strides, dtype] = this.data.actions, kind = ARRAYS[dtype];
    for (const [lane, action] of Object.entries(given)) {
      const values = [action].flat(), start = offset + lane * strides[0] * kind.BYTES_PER_ELEMENT;
      this.array([buffer, start], values.length, kind).set(dtype === "int64" ? values.map(BigInt) : values);
    }
    this.run("step");
  }
}

// ---- The game: one environment, or two to race in, and what happened there ----

class Game {
  constructor(parts) {
    Object.assign(this, { parts, data: parts.data, isDriving: false, simulations: [new Simulation(parts)] });
    this.reset(this.data.seed);
  }

  reset(seed, home = null) {
    const { n_lanes: n, policies } = this.data, isRace = this.isDriving && n === 1;
    if (isRace) this.simulations[1] ??= new Simulation(this.parts);
    this.running = this.simulations.slice(0, isRace ? 2 : 1);
    this.running.forEach(simulation => simulation.reset(seed, home));
    Object.assign(this, { seed, steps: 0, episodes: [] });
    this.players = this.running.flatMap((simulation, i) => Array.from({ length: n }, (_, lane) => {
      const isHuman = this.isDriving && !i && !lane, own = policies.find(({ lanes: [a, b] }) => a <= lane && lane < b);
      return { simulation, lane, isHuman, own, name: isHuman ? "you" : own?.name ?? "nobody", number: 0 };
    }));
    this.players.forEach(player => this.follow(player));
  }

  step(action) {
    this.running.forEach((simulation, i) => simulation.step(this.isDriving && !i ? { 0: action } : {}));
    this.players.forEach(player => this.follow(player));
    this.steps++;
  }

  // Notes what a step did to a player.
  follow(player) {
    const { simulation, lane } = player, value = path => simulation.world(path, lane)[0];
    if (value("reset")) Object.assign(player, { number: player.number + 1, score: 0, length: -1, trail: [] });
    player.score += value("reward");
    player.length++;
    const at = simulation.field("positions", 2 * lane + 2)?.slice(2 * lane);
    if (at) player.trail.push(at);
    if (!value("terminal") && !value("truncated")) return;
    const metrics = Object.keys(this.data.world).filter(path => path.startsWith("metrics."));
    this.episodes.push({ name: player.name, number: player.number, return: player.score, length: player.length,
      metrics: Object.fromEntries(metrics.map(path => [path.slice(8), value(path)])) });
  }
}

// ---- Drawing ----

const byId = id => document.getElementById(id);
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const encode = light => {
  const x = Math.min(Math.max(light, 0), 1);
  return 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
};
const colour = (light, factor = 1) => `rgb(${Array.from(light, x => Math.round(encode(x) * factor))})`;

function shape(context, points, fill, stroke, width = 1.3) {
  context.beginPath();
  points instanceof Function ? points(context) : points.forEach(point => context.lineTo(...point));
  if (fill) { context.fillStyle = fill; context.fill(); }
  if (stroke) { Object.assign(context, { strokeStyle: stroke, lineWidth: width }); context.stroke(); }
}
const disc = (context, [x, y], radius, ...look) => shape(context, c => c.arc(x, y, radius, 0, 7), ...look);

// The floor and the walls of a home, drawn once, and completed as the agent looks around.
class Plan {
  constructor(simulation, width, height, ratio) {
    const { layout } = simulation, size = { width: width * ratio, height: height * ratio };
    const [first, end] = simulation.field("scenery.wall_starts", layout + 2, Int32Array).subarray(layout);
    this.walls = simulation.field("scenery.walls", 4 * end).slice(4 * first);
    this.starts = simulation.field("scenery.texel_starts", end + 1, Int32Array).slice(first);
    this.texels = simulation.field("scenery.texels", 4 * this.starts.at(-1));
    const n_words = simulation.word("n_words");
    this.seen = simulation.data.n_lanes === 1 && n_words && simulation.field("seen", n_words, Uint32Array);
    this.drawn = new Set();
    const of = axis => this.walls.filter((_, i) => i % 2 === axis);
    const [x0, y0, x1, y1] = [Math.min, Math.max].flatMap(most => [0, 1].map(axis => most(...of(axis))));
    this.scale = Math.min(width / (x1 - x0 + 0.5), height / (y1 - y0 + 0.5));
    this.at = ([x, y]) => [width / 2 + this.scale * (x - (x0 + x1) / 2), height / 2 - this.scale * (y - (y0 + y1) / 2)];
    const layer = () => Object.assign(document.createElement("canvas"), size).getContext("2d");
    [this.floor, this.wall] = [layer(), layer()];
    for (const context of [this.floor, this.wall]) context.scale(ratio, ratio);
    const rooms = new Path2D(), { rooms: all } = simulation.data;
    all[layout].forEach(room => rooms.addPath(new Path2D(`M${room.map(this.at).join("L")}Z`)));
    this.floor.fillStyle = css(this.seen ? "--unseen" : "--floor");
    this.floor.fill(rooms, "evenodd");
    this.floor.clip(rooms, "evenodd");
    this.wall.lineCap = "square";
    this.draw(true);
  }

  // Draws the texels that were seen since the last call, grey where they were not, or all.
  draw(isAll) {
    const [low, high] = [css("--wall-low"), css("--wall-high")].map(Number), grey = css("--unseen-wall");
    for (let wall = 0; wall < this.starts.length - 1; wall++) {
      const [ax, ay, bx, by] = this.walls.subarray(4 * wall), [start, end] = this.starts.subarray(wall);
      const point = i => this.at([ax + (i - start) / (end - start) * (bx - ax), ay + (i - start) / (end - start) * (by - ay)]);
      for (let i = start; i < end; i++) {
        const bit = i - this.starts[0], isSeen = !this.seen || this.seen[bit >> 5] >>> (bit & 31) & 1;
        if (!(isAll || isSeen) || this.drawn.has(i)) continue;
        if (isSeen) this.drawn.add(i);
        const light = this.texels.subarray(4 * i, 4 * i + 3), peak = Math.max(...light, 1e-6);
        const shown = colour(light.map(x => x / peak), low + (high - low) * encode(2.5 * peak) / 255);
        shape(this.wall, [point(i), point(i + 1)], null, isSeen ? shown : grey, 3.4);
      }
    }
  }
}

// Returns the corners of what an agent sees, in metres, by its depth image; none without one.
function sight({ simulation: { data, ...rest }, simulation, lane }) {
  const depth = data.world["obs.d"];
  if (!depth || depth[2][3] > 1) return [];
  const [x, y] = simulation.field("positions", 2 * lane + 2).subarray(2 * lane);
  const angle = simulation.field("angles", lane + 1)[lane] * Math.PI / 180;
  return [[x, y], ...simulation.world("obs.d", lane).map((d, i, { length: n }) => {
    const side = angle + Math.atan(Math.tan(data.fov * Math.PI / 360) * (n - 1 - 2 * i) / n);
    const metres = data.radius + 10 * (1 - d);
    return [x + metres * Math.cos(side), y + metres * Math.sin(side)];
  })];
}

// Draws discs, crates and doors: records of 32 bytes, as megastep/kernels/common/objects.h has them.
function drawObjects(simulation, plan, context) {
  const n = simulation.word("objects.n_objects") ?? 0, field = (...at) => simulation.field(...at);
  for (let i = 0; i < n; i++) {
    const [x, y, degrees, size] = field("objects.objects", 8 * n).subarray(8 * i);
    const [visible, , isOpen] = field("objects.objects", 32 * n, Uint8Array).subarray(32 * i + 24);
    const hue = 3 * field("objects.objects", 8 * n, Int32Array)[8 * i + 5];
    const kind = field("objects.shapes", n, Int32Array)[i], angle = degrees * Math.PI / 180;
    const fill = colour(field("objects.palette", hue + 3).subarray(hue)), look = [fill, css("--text"), 1];
    const corner = (a, b) => plan.at([x + size * (a * Math.cos(angle) - b * Math.sin(angle)),
      y + size * (a * Math.sin(angle) + b * Math.cos(angle))]);
    if (!visible || isOpen) continue;
    if (kind === 0) disc(context, plan.at([x, y]), Math.max(size * plan.scale, 3), ...look);
    else if (kind === 1) shape(context, [corner(1, 1), corner(-1, 1), corner(-1, -1), corner(1, -1), corner(1, 1)], ...look);
    else shape(context, [corner(-1, 0), corner(1, 0)], null, fill, 4);
  }
}

let plan = null;

function drawPlan(game, context, width, height, ratio) {
  const [{ simulation, trail }] = game.players, { data } = game, { layout } = simulation;
  const key = [layout, width, height, css("--page"), game.seed, game.players[0].number].join();
  if (plan?.key !== key) plan = Object.assign(new Plan(simulation, width, height, ratio), { key });
  const sights = game.players.map(player => sight(player).map(plan.at));
  if (plan.seen) {
    plan.draw(false);
    shape(plan.floor, sights[0], css("--floor"));
  }
  for (const layer of [plan.floor, plan.wall]) context.drawImage(layer.canvas, 0, 0, width, height);
  if (data.goal) {
    const { base, per_layout, stride, index, radius } = data.goal;
    const number = Array.isArray(index) ? simulation.array(index, 1, Int32Array)[0] : index;
    const first = per_layout * layout + stride * number, at = simulation.array(base, first + 2).subarray(first);
    disc(context, plan.at(at), Math.max(1.6 * radius * plan.scale, 12), "#1fa94c40", "#1fa94c", 2);
  }
  drawObjects(simulation, plan, context);
  game.players.forEach(({ simulation: own, lane, trail, isHuman }, i) => {
    if (own.layout !== layout) return;
    context.globalAlpha = own === simulation ? 1 : 0.5;
    const fill = data.colours[i % data.colours.length], position = trail.at(-1), centre = plan.at(position);
    const angle = own.field("angles", lane + 1)[lane] * Math.PI / 180, size = Math.max(7, data.radius * plan.scale);
    shape(context, sights[i], `${fill}38`);
    shape(context, trail.slice(-500).map(plan.at), null, fill, 2);
    const line = own.field("centre_line", lane + 1, Int32Array)?.[lane] ?? -1;
    const target = game.players[Math.floor(line / own.word("scenery.n_model"))];
    if (line >= 0 && target) shape(context, [centre, plan.at(target.trail.at(-1))], null, fill, 2);
    shape(context, [[0.8, 1.05], [0, 1.8], [-0.8, 1.05]].map(([turn, far]) => (
      [centre[0] + size * far * Math.cos(angle + turn), centre[1] - size * far * Math.sin(angle + turn)])), fill);
    disc(context, centre, size, fill, isHuman ? css("--text") : "#fff", isHuman ? 2.5 : 1.3);
    context.globalAlpha = 1;
  });
}

// Draws a court of 40 x 30 cells: megastep/envs/pong.
function drawPong(game, context, width, height) {
  const state = game.running[0].field("games", 13, Int32Array), scale = Math.min(width / 42, height / 32);
  const [left, top] = [(width - 40 * scale) / 2, (height - 30 * scale) / 2], cell = i => Math.floor(state[i] / 256);
  const box = (x, y, w, h, fill) => {
    context.fillStyle = fill;
    context.fillRect(left + x * scale, top + y * scale, w * scale, h * scale);
  };
  box(0, 0, 40, 30, css("--floor"));
  box(19.95, 0, 0.1, 30, css("--hatch"));
  box(cell(4), cell(5), 1, 1, css("--unseen-wall"));
  box(cell(0), cell(1), 1, 1, css("--text"));
  [0, 1].forEach(side => box(39 * side, cell(6 + side), 1, 4, game.data.colours[side]));
  Object.assign(context, { font: `${1.6 * scale}px sans-serif`, textAlign: "center", fillStyle: css("--faint") });
  context.fillText(`${state[8]} : ${state[9]}`, width / 2, top + 2 * scale);
}

// Draws rows of [red, green, blue] from 0 to 255 as pixels.
function drawPixels(canvas, rows) {
  Object.assign(canvas, { width: rows[0].length, height: rows.length });
  const bytes = rows.flat().flatMap(pixel => [...pixel, 255]);
  canvas.getContext("2d").putImageData(new ImageData(Uint8ClampedArray.from(bytes), rows[0].length), 0, 0);
}

// Draws what a player sees and remembers.
function drawPlayer(player) {
  const { simulation, lane, own, element } = player, { world } = simulation.data, texts = [];
  const [name, score, small] = element.querySelectorAll("span, b, p");
  const canvases = [...element.querySelectorAll("canvas")];
  const leaves = Object.keys(world).filter(path => path.startsWith("obs"));
  for (const path of leaves) {
    const [, , [, , n, height, width], , dtype] = world[path], values = simulation.world(path, lane);
    if (width === undefined) {
      texts.push(`${path.slice(4) || "sees"} ${values.map(x => x.toFixed(2)).join(" ")}`);
      continue;
    }
    const at = (c, y, x) => values[(Math.min(c, n - 1) * height + y) * width + x];
    const shown = x => (dtype === "uint8" ? x : n === 1 ? 255 * x : encode(x));
    drawPixels(canvases.shift(), Array.from({ length: height }, (_, y) => Array.from({ length: width }, (_, x) => (
      [0, 1, 2].map(c => shown(at(c, y, x)))))));
  }
  if (own && own.states.length) {
    const unit = x => [128 + 120 * x, 128, 128 - 120 * x];
    drawPixels(canvases[0], own.states.map(leaf => simulation.leaf(leaf, lane - own.lanes[0]).map(x => unit(Math.tanh(x)))));
  }
  name.textContent = player.name;
  score.textContent = player.score.toFixed(2);
  small.textContent = `episode ${player.number}, step ${player.length} · ${texts.join(" · ")}`;
}

// ---- The page ----

async function main() {
  const problem = byId("problem");
  if (typeof WebAssembly !== "object" || typeof DecompressionStream !== "function") {
    problem.textContent = "This page needs WebAssembly, which browsers have since 2023: open it in a newer one.";
    return;
  }
  const game = new Game(await unpacked(byId("data").textContent.trim())), { data } = game;
  const canvas = byId("plan"), held = new Set(), hasHomes = data.homes.length > 1;
  let isPlaying = true, isDirty = true, owed = 0, before = performance.now();
  const speed = () => Number(byId("speed").value);
  problem.textContent = "";
  document.querySelector("h1").textContent = data.title;
  byId("about").textContent = data.about;
  byId("home").hidden = !hasHomes;

  function action() {
    const keys = [...held], values = keys.map(key => data.controls[key]);
    if (!Array.isArray(data.rest)) return keys.length ? values[game.steps % keys.length] : data.rest;
    return data.rest.map((rest, i) => values.reduce((sum, value) => sum + value[i], rest));
  }
  function step(n = 1) {
    for (let i = 0; i < n; i++) game.step(action());
    isDirty = true;
  }
  function play(yes = true) {
    isPlaying = yes;
    byId("play").textContent = yes ? "Pause" : "Play";
  }
  function reset(seed = game.seed, home = null) {
    game.reset(seed, home);
    byId("seed").value = seed;
    byId("players").replaceChildren(...game.players.map((player, i) => {
      const rows = Object.entries(data.world).filter(([path, leaf]) => path.startsWith("obs") && leaf[2].length > 4);
      player.element = Object.assign(document.createElement("div"), { className: "player" });
      player.element.innerHTML = `<header><span></span><b></b></header>${"<canvas></canvas>".repeat(
        rows.length + (player.own?.states.length ? 1 : 0))}<p class="small"></p>`;
      player.element.querySelector("span").style.color = data.colours[i % data.colours.length];
      return player.element;
    }));
    isDirty = true;
  }
  function drive(yes = true) {
    if (yes === game.isDriving) return;
    game.isDriving = yes;
    held.clear();
    document.body.classList.toggle("driving", yes);
    byId("drive").textContent = yes ? "Hand back" : data.n_lanes === 1 ? "Race it" : "Take over";
    byId("drive").setAttribute("aria-pressed", yes);
    reset(game.seed, hasHomes ? game.running[0].layout : null);
  }
  function press(key, isDown) {
    if (!(key in data.controls)) return false;
    if (isDown) drive();
    isDown ? held.add(key) : held.delete(key);
    return true;
  }
  const nextHome = () => hasHomes && reset(game.seed, (game.running[0].layout + 1) % data.homes.length);
  const commands = {
    " ": () => play(!isPlaying), ".": () => { play(false); step(); }, t: () => drive(!game.isDriving), n: nextHome,
    r: () => reset(), Escape: () => drive(false),
  };
  for (const [id, key] of Object.entries({ play: " ", one: ".", drive: "t", home: "n", restart: "r" })) {
    byId(id).onclick = () => commands[key]();
  }
  byId("seed").onchange = event => reset(Math.min(Math.max(Math.trunc(event.target.value), 0), 2 ** 32 - 1));
  addEventListener("keydown", event => {
    if (event.target.matches("input, select") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.matches("button") && event.key === " ") return;
    if (press(event.key, true)) event.preventDefault();
    else if (commands[event.key] && !event.repeat) { event.preventDefault(); commands[event.key](); }
  });
  addEventListener("keyup", event => press(event.key, false));
  addEventListener("blur", () => held.clear());
  const symbols = { ArrowUp: "▲", ArrowDown: "▼", ArrowLeft: "◀", ArrowRight: "▶" };
  byId("pad").append(...Object.keys(data.controls).map(key => {
    const button = Object.assign(document.createElement("button"), { textContent: symbols[key] ?? key });
    button.onpointerdown = event => { event.preventDefault(); press(key, true); };
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) button[`on${end}`] = () => press(key, false);
    return button;
  }));
  byId("keys").textContent = `Space plays and pauses, . steps, T takes over (${Object.keys(data.controls).map(
    key => symbols[key] ?? key).join(" ")} drive), Escape hands back, ${hasHomes ? "N next home, " : ""}R begins anew.`;

  function draw() {
    const ratio = devicePixelRatio, { clientWidth: width, clientHeight: height } = canvas;
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    if (data.rooms) drawPlan(game, context, width, height, ratio);
    else if (game.running[0].word("games")) drawPong(game, context, width, height);
    game.players.forEach(drawPlayer);
    const { length } = game.episodes, last = game.episodes[length - 1];
    byId("log").textContent = last ? `Last of ${length} episodes: ${last.name}, return ${last.return.toFixed(2)} after ${
      last.length} steps; ${Object.entries(last.metrics).map(([key, x]) => `${key} ${x.toFixed(2)}`).join(", ")}.` : "";
  }
  function frame(now) {
    owed = isPlaying ? owed + Math.min(now - before, 200) / 1000 * data.fps * speed() : 0;
    before = now;
    for (const end = performance.now() + 12; owed >= 1; owed--) {
      step();
      if (performance.now() > end) owed = 1;
    }
    if (isDirty) draw();
    isDirty = false;
    requestAnimationFrame(frame);
  }
  addEventListener("resize", () => { isDirty = true; });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { isDirty = true; });
  drive.call(null, false);
  byId("drive").textContent = data.n_lanes === 1 ? "Race it" : "Take over";
  reset();
  globalThis.megastep = {
    game, play, pause: () => play(false), step, reset, drive, press,
    get steps() { return game.steps; },
    get returns() { return game.players.map(player => player.score); },
    get episodes() { return game.episodes; },
  };
  requestAnimationFrame(frame);
}

if (typeof document === "object") {
  main().catch(error => { byId("problem").textContent = `This page cannot be played here: ${error.message}`; });
}
