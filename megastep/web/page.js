// The page: plays a program of program.js, and draws what some fields of kernels hold.
"use strict";

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
    Object.assign(this, { seed, steps: 0, episodes: [], n_resets: (this.n_resets ?? 0) + 1 });
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
    const { layout, data } = simulation;
    this.simulation = simulation;
    const [first, end] = simulation.field("scenery.wall_starts", layout + 2, Int32Array).subarray(layout);
    this.walls = simulation.field("scenery.walls", 4 * end).slice(4 * first);
    this.starts = simulation.field("scenery.texel_starts", end + 1, Int32Array).slice(first);
    this.n_words = data.n_lanes === 1 ? simulation.word("n_words") : 0;  // of a bit per texel that was seen
    this.drawn = new Set();
    const of = axis => this.walls.filter((_, i) => i % 2 === axis);
    const [x0, y0, x1, y1] = [Math.min, Math.max].flatMap(most => [0, 1].map(axis => most(...of(axis))));
    this.scale = Math.min(width / (x1 - x0 + 0.5), height / (y1 - y0 + 0.5));
    this.at = ([x, y]) => [width / 2 + this.scale * (x - (x0 + x1) / 2), height / 2 - this.scale * (y - (y0 + y1) / 2)];
    [this.floor, this.wall] = [0, 1].map(() => {
      const canvas = Object.assign(document.createElement("canvas"), { width: width * ratio, height: height * ratio });
      return canvas.getContext("2d");
    });
    for (const layer of [this.floor, this.wall]) layer.scale(ratio, ratio);
    const rooms = new Path2D(data.rooms[layout].map(room => `M${room.map(this.at).join("L")}Z`).join(""));
    this.floor.fillStyle = css(this.n_words ? "--unseen" : "--floor");
    this.floor.fill(rooms, "evenodd");
    this.floor.clip(rooms, "evenodd");
    this.wall.lineCap = "square";
    this.draw(true);
  }

  // Draws the texels that were seen since the last call, or all, grey where they were not seen.
  draw(isAll) {
    const [low, high] = [css("--wall-low"), css("--wall-high")].map(Number), grey = css("--unseen-wall");
    const texels = this.simulation.field("scenery.texels", 4 * this.starts.at(-1));
    const seen = this.n_words && this.simulation.field("seen", this.n_words, Uint32Array);
    for (let wall = 0; wall < this.starts.length - 1; wall++) {
      const [ax, ay, bx, by] = this.walls.subarray(4 * wall), [start, end] = this.starts.subarray(wall);
      const point = i => [(i - start) / (end - start)].flatMap(t => this.at([ax + t * (bx - ax), ay + t * (by - ay)]));
      for (let i = start; i < end; i++) {
        const bit = i - this.starts[0], isSeen = !seen || seen[bit >> 5] >>> (bit & 31) & 1;
        if (!(isAll || isSeen) || this.drawn.has(i)) continue;
        if (isSeen) this.drawn.add(i);
        const light = texels.subarray(4 * i, 4 * i + 3), peak = Math.max(...light, 1e-6);
        const shown = colour(light.map(x => x / peak), low + (high - low) * encode(2.5 * peak) / 255);
        shape(this.wall, [point(i), point(i + 1)], null, isSeen ? shown : grey, 3.4);
      }
    }
  }
}

// Returns the corners of what an agent sees, in metres, by its depth image; none without one.
function sight({ simulation, lane }) {
  const { data } = simulation, depth = data.world["obs.d"];
  if (!depth || depth[2][3] > 1) return [];
  const [x, y] = simulation.field("positions", 2 * lane + 2).subarray(2 * lane);
  const angle = simulation.field("angles", lane + 1)[lane] * Math.PI / 180;
  return [[x, y], ...simulation.world("obs.d", lane).map((d, i, { length: n }) => {
    const side = angle + Math.atan(Math.tan(data.fov * Math.PI / 360) * (n - 1 - 2 * i) / n);
    const metres = data.radius + 10 * (1 - d);
    return [x + metres * Math.cos(side), y + metres * Math.sin(side)];
  })];
}

// Draws discs, crates, ramps and doors: records of 32 bytes, as megastep/kernels/common/objects.h has them.
function drawObjects(simulation, plan, context) {
  const n = simulation.word("objects.n_objects") ?? 0, field = (...at) => simulation.field(...at);
  for (let i = 0; i < n; i++) {
    const [x, y, degrees, size] = field("objects.objects", 8 * n).subarray(8 * i);
    const [visible, , isOpen] = field("objects.objects", 32 * n, Uint8Array).subarray(32 * i + 24);
    const hue = 3 * field("objects.objects", 8 * n, Int32Array)[8 * i + 5];
    const kind = field("objects.shapes", n, Int32Array)[i], angle = degrees * Math.PI / 180;
    const fill = colour(field("objects.palette", hue + 3).subarray(hue)), look = [fill, css("--text"), 1];
    const line = field("objects.line_starts", n, Int32Array)[i], width = -field("objects.ends", 4 * line + 2)[4 * line + 1];
    const corner = (a, b) => plan.at([x + size * (a * Math.cos(angle) - b * width * Math.sin(angle)),
      y + size * (a * Math.sin(angle) + b * width * Math.cos(angle))]);
    if (!visible || isOpen) continue;
    if (kind === 0) disc(context, plan.at([x, y]), Math.max(size * plan.scale, 3), ...look);
    else if (kind === 1) shape(context, [corner(1, 1), corner(-1, 1), corner(-1, -1), corner(1, -1), corner(1, 1)], ...look);
    else if (kind === 3) shape(context, [corner(-1, 1), corner(1, 1), corner(1, -1), corner(-1, -1)], ...look);
    else shape(context, [corner(-1, 0), corner(1, 0)], null, fill, 4);
  }
}

let plan = null;

function drawPlan(game, context, width, height, ratio) {
  const [{ simulation }] = game.players, { data } = game, { layout } = simulation;
  const key = [layout, width, height, css("--page"), game.n_resets, game.players[0].number].join();
  if (plan?.key !== key) plan = Object.assign(new Plan(simulation, width, height, ratio), { key });
  const sights = game.players.map(player => sight(player).map(plan.at));
  if (plan.n_words) {
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
    const looked = trail.length > 1 ? own.field("centre_line", lane + 1, Int32Array) : null;
    const line = looked?.[lane] ?? -1;  // nobody hits on a first observation
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
  const cells = [...state].map(x => Math.floor(x / 256)), { colours } = game.data;
  context.translate((width - 40 * scale) / 2, (height - 30 * scale) / 2);
  for (const [fill, ...box] of [[css("--floor"), 0, 0, 40, 30], [css("--hatch"), 19.95, 0, 0.1, 30],
    [css("--unseen-wall"), cells[4], cells[5], 1, 1], [css("--text"), cells[0], cells[1], 1, 1],
    [colours[0], 0, cells[6], 1, 4], [colours[1], 39, cells[7], 1, 4]]) {
    context.fillStyle = fill;
    context.fillRect(...box.map(x => x * scale));
  }
  Object.assign(context, { font: `${1.6 * scale}px sans-serif`, textAlign: "center", fillStyle: css("--faint") });
  context.fillText(`${state[8]} : ${state[9]}`, 20 * scale, 2 * scale);
}

// Draws boards of cells that hold 0 or 1 in several channels, the first player's: megastep/envs/minatar.
function drawMinAtar(game, context, width, height) {
  const { colours, world: { obs: [, , [, , , rows, columns]] } } = game.data, [{ simulation, lane }] = game.players;
  const scale = Math.min(width / (columns + 1), height / (rows + 1)), size = rows * columns;
  context.translate((width - columns * scale) / 2, (height - rows * scale) / 2);
  context.fillStyle = css("--floor");
  context.fillRect(0, 0, columns * scale, rows * scale);
  simulation.world("obs", lane).forEach((value, i) => {
    if (!value) return;
    context.fillStyle = colours[Math.floor(i / size) % colours.length];
    context.fillRect(i % columns * scale, Math.floor(i % size / columns) * scale, scale, scale);
  });
}

// Draws what a cell of MiniGrid holds around 0, as megastep/envs/minigrid/drawing.py does.
const GRID = ["#e5484d", "#30a46c", "#3e63dd", "#8e4ec6", "#f5d90a", "#8b8d98"];
function drawCell(context, cell) {
  const kind = cell & 15, hue = GRID[cell >> 4], square = x => [[-x, -x], [x, -x], [x, x], [-x, x], [-x, -x]];
  if ([2, 8, 9].includes(kind)) shape(context, square(0.5), kind === 9 ? "#ff8000" : hue);
  if ([4, 10, 11].includes(kind)) shape(context, square(0.45), null, hue, 0.06);
  if (kind > 9) shape(context, square(0.3), hue + (kind === 11 ? "cc" : "4d"));
  if (kind === 6) disc(context, [0, 0], 0.31, hue);
  if (kind === 7) [[...square(0.35)], [[-0.35, 0], [0.35, 0]]].forEach(line => shape(context, line, null, hue, 0.08));
  if (kind !== 5) return;
  disc(context, [0, -0.2], 0.16, hue);
  [[[0, -0.2], [0, 0.35]], [[0, 0.3], [0.18, 0.3]]].forEach(line => shape(context, line, null, hue, 0.08));
}

// Draws a grid and its agent: megastep/envs/minigrid.
function drawMiniGrid({ running: [simulation] }, context, width, height) {
  const [columns, rows] = [simulation.word("width"), simulation.word("height")];
  const [x, y, direction, carried] = simulation.field("games", 4, Int32Array);
  const scale = Math.min(width / (columns + 1), height / (rows + 1));
  const within = (left, top, size, draw) => {
    context.save();
    context.translate((width - columns * scale) / 2 + left * scale, (height - rows * scale) / 2 + top * scale);
    context.scale(size * scale, size * scale);
    draw();
    context.restore();
  };
  context.fillStyle = css("--floor");
  within(0, 0, 1, () => context.fillRect(0, 0, columns, rows));
  simulation.field("cells", columns * rows, Uint8Array).forEach((cell, i) => (
    within(i % columns + 0.5, Math.floor(i / columns) + 0.5, 1, () => drawCell(context, cell))));
  within(x + 0.5, y + 0.5, 1, () => {
    context.rotate(direction * Math.PI / 2);
    shape(context, [[-0.3, -0.3], [0.38, 0], [-0.3, 0.3]], css("--text"));
  });
  within(x + 0.8, y + 0.2, 0.45, () => drawCell(context, carried));
}

// Draws rows of [red, green, blue] from 0 to 255 as pixels.
function drawPixels(canvas, rows) {
  Object.assign(canvas, { width: rows[0].length, height: rows.length });
  const bytes = rows.flat().flatMap(pixel => [...pixel, 255]);
  canvas.getContext("2d").putImageData(new ImageData(Uint8ClampedArray.from(bytes), rows[0].length), 0, 0);
}

// Draws what a player sees and remembers: images, other numbers, and the hidden state in colours.
function drawPlayer({ simulation, lane, own, isHuman, element, name, score, number, length }) {
  const { world } = simulation.data, canvases = [...element.querySelectorAll("canvas")], texts = [];
  for (const path of Object.keys(world).filter(path => path.startsWith("obs"))) {
    const [, , [, , n, height, width], , dtype] = world[path], values = simulation.world(path, lane);
    if (width === undefined) texts.push(` · ${path.slice(4) || "sees"} ${values.map(x => x.toFixed(2)).join(" ")}`);
    else drawPixels(canvases.shift(), Array.from({ length: height }, (_, y) => Array.from({ length: width }, (_, x) => (
      [0, 1, 2].map(c => values[(Math.min(c, n - 1) * height + y) * width + x]).map(value => (
        dtype === "uint8" ? ({ MinAtar: 255, MiniGrid: 25 }[simulation.data.env] ?? 1) * value : n === 1 ? 255 * value : encode(value)))))));
  }
  const unit = x => [128 + 120 * Math.tanh(x), 128, 128 - 120 * Math.tanh(x)];
  const states = isHuman || !own ? [] : own.states.map(leaf => simulation.leaf(leaf, lane - own.lanes[0]).map(unit));
  if (states.length) drawPixels(canvases[0], states);
  const [title, sum, small] = element.querySelectorAll("span, b, p");
  [title.textContent, sum.textContent] = [name, score.toFixed(2)];
  small.textContent = `episode ${number}, step ${length}${texts.join("")}`;
}

// ---- The page ----

async function main() {
  if (typeof WebAssembly !== "object" || typeof DecompressionStream !== "function") {
    throw new Error("it needs WebAssembly and DecompressionStream, which browsers have since 2023; open a newer one");
  }
  const game = new Game(await unpacked(byId("data").textContent.trim())), { data } = game, held = new Set();
  const keys = Object.keys(data.controls), hasHomes = data.homes.length > 1, canvas = byId("plan");
  const symbols = { ArrowUp: "▲", ArrowDown: "▼", ArrowLeft: "◀", ArrowRight: "▶" }, sign = key => symbols[key] ?? key;
  let isPlaying = true, isDirty = true, owed = 0, before = performance.now();

  function action() {
    const values = [...held].map(key => data.controls[key]);
    return values.length ? values[game.steps % values.length] : 0;
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
      const images = Object.entries(data.world).filter(([path, leaf]) => path.startsWith("obs") && leaf[2].length > 4);
      const n = images.length + (!player.isHuman && player.own?.states.length ? 1 : 0);
      player.element = Object.assign(document.createElement("div"), { className: "player" });
      player.element.innerHTML = `<header><span style="color:${data.colours[i % data.colours.length]}"></span><b></b></header>${
        "<canvas></canvas>".repeat(n)}<p class="small"></p>`;
      return player.element;
    }));
    isDirty = true;
  }
  function drive(yes = true) {
    held.clear();
    if (yes === game.isDriving) return;
    game.isDriving = yes;
    document.body.classList.toggle("driving", yes);
    byId("drive").textContent = yes ? "Hand back" : data.n_lanes === 1 ? "Race it" : "Take over";
    byId("drive").setAttribute("aria-pressed", yes);
    reset(game.seed, hasHomes ? game.running[0].layout : null);
  }
  function press(key, isDown) {
    if (isDown && !game.isDriving) drive();
    isDown ? held.add(key) : held.delete(key);
  }
  const commands = {
    " ": () => play(!isPlaying), ".": () => { play(false); step(); }, t: () => drive(!game.isDriving),
    n: () => hasHomes && reset(game.seed, (game.running[0].layout + 1) % data.homes.length), r: () => reset(),
    Escape: () => drive(false),
  };
  for (const [id, key] of Object.entries({ play: " ", one: ".", drive: "t", home: "n", restart: "r" })) {
    byId(id).onclick = () => commands[key]();
  }
  byId("seed").onchange = event => reset(Math.min(Math.max(Math.trunc(event.target.value), 0), 2 ** 32 - 1));
  addEventListener("keydown", event => {
    const { key, target, repeat } = event, isTyping = target.matches("input, select") || event.ctrlKey || event.metaKey;
    if (isTyping || (target.matches("button") && key === " ") || !(keys.includes(key) || commands[key])) return;
    event.preventDefault();
    if (keys.includes(key)) press(key, true);
    else if (!repeat) commands[key]();
  });
  addEventListener("keyup", event => held.delete(event.key));
  addEventListener("blur", () => held.clear());
  byId("pad").append(...keys.map(key => {
    const button = Object.assign(document.createElement("button"), { textContent: sign(key), ariaLabel: key });
    button.onpointerdown = () => press(key, true);
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) button[`on${end}`] = () => press(key, false);
    return button;
  }));

  function draw() {
    const { clientWidth: width, clientHeight: height } = canvas, ratio = devicePixelRatio, { episodes } = game;
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    const context = canvas.getContext("2d"), last = episodes.at(-1);
    context.scale(ratio, ratio);
    if (data.rooms) drawPlan(game, context, width, height, ratio);
    else if (data.env === "MinAtar") drawMinAtar(game, context, width, height);
    else if (data.env === "MiniGrid") drawMiniGrid(game, context, width, height);
    else if (game.running[0].word("games")) drawPong(game, context, width, height);
    game.players.forEach(drawPlayer);
    Object.assign(context, { font: "600 14px system-ui, sans-serif", textAlign: "left" });
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    game.players.forEach(({ name, score }, i) => {
      context.fillStyle = data.colours[i % data.colours.length];
      context.fillText(`${name} ${score.toFixed(2)}`, 10, 20 + 18 * i);
    });
    byId("log").textContent = last ? `Last of ${episodes.length} episodes: ${last.name}, return ${last.return.toFixed(2)} after ${
      last.length} steps; ${Object.entries(last.metrics).map(([key, x]) => `${key} ${x.toFixed(2)}`).join(", ")}.` : "";
  }
  function frame(now) {
    owed = isPlaying ? owed + Math.min(now - before, 200) / 1000 * data.fps * Number(byId("speed").value) : 0;
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

  document.querySelector("h1").textContent = data.title;
  byId("about").textContent = data.about;
  byId("home").hidden = !hasHomes;
  byId("drive").textContent = data.n_lanes === 1 ? "Race it" : "Take over";
  byId("keys").textContent = `Space plays and pauses, . steps, T takes over, ${keys.map(sign).join(" ")} drive, Escape hands back, ${
    hasHomes ? "N shows the next home, " : ""}R begins anew.`;
  reset();
  globalThis.megastep = {
    game, play, pause: () => play(false), step, reset, drive, press, started: performance.now(),
    get steps() { return game.steps; },
    get returns() { return game.players.map(player => player.score); },
    get episodes() { return game.episodes; },
  };
  byId("problem").textContent = "";
  requestAnimationFrame(frame);
}

main().catch(error => { byId("problem").textContent = `This page cannot be played here: ${error.message}.`; });
