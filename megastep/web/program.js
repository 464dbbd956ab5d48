// A program of kernels in WebAssembly, and the memory of one environment. The program is data: lists of
// launches, the memory that they read and write, and where in it the world lies. Nothing here knows how
// an environment works. Runs in a browser and in node.
"use strict";

const HALVES = Float32Array.from({ length: 65536 }, (_, bits) => {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023, sign = bits & 32768 ? -1 : 1;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : fraction / 2 ** 24);
});
const ARRAYS = { float16: Uint16Array, float32: Float32Array, uint8: Uint8Array, bool: Uint8Array, int64: BigInt64Array };

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
