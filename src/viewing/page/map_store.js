// The Gaussians of the map, by chunk, in words as the textures take them. Chunks own rows of ROW slots; a freed row is used again.

// Slots of a row: the unit in which chunks take space.
export const ROW = 256;
// Slots side by side in a texture.
export const TEXTURE_SLOTS = 1024;
export const BASE_WORDS_EACH = 8;
const FIRST_LINES = 16;
const ROWS_A_LINE = TEXTURE_SLOTS / ROW;

const halfBits = new Float32Array(1);
const halfWord = new Uint32Array(halfBits.buffer);

// A positive number as f16, in 16 bits.
function halfOf(value) {
  halfBits[0] = clampToHalf(value);
  const bits = halfWord[0];
  const exponent = (bits >>> 23) - 112;
  if (exponent <= 0) {
    return 0;
  }
  return ((exponent << 10) + (((bits & 0x7fffff) + 0x1000) >>> 13)) & 0x7fff;
}

function clampToHalf(value) {
  return Number.isFinite(value) && value > 0 ? Math.min(value, 65000) : 0;
}

export class MapStore {
  // `mirror(message)` gets what the sort worker needs to know of each change.
  constructor(mirror) {
    this.mirror = mirror;
    this.version = 0;
    this.lines = 0;
    this.degree = 0;
    this.antialiased = false;
    this.base = new Uint32Array(0);
    this.harmonics = new Uint32Array(0);
    this.dirty = new Uint8Array(0);
    this.clear();
  }

  clear() {
    this.chunks = new Map();
    this.free = [];
    this.rowsUsed = 0;
    this.gaussians = 0;
    this.digest = 0;
    this.version += 1;
    this.mirror({ type: "clear" });
  }

  // Room for so many texture lines; what is held stays.
  growLines(lines) {
    let to = Math.max(this.lines, FIRST_LINES);
    while (to < lines) {
      to *= 2;
    }
    if (to === this.lines) {
      return;
    }
    const grown = (old, each) => {
      const larger = new Uint32Array(to * TEXTURE_SLOTS * each);
      larger.set(old);
      return larger;
    };
    this.base = grown(this.base, BASE_WORDS_EACH);
    this.harmonics = grown(this.harmonics, 4 * this.degree);
    this.dirty = new Uint8Array(to).fill(1);
    this.lines = to;
  }

  // Harmonics of a higher degree than before: those held are spread out.
  growDegree(degree) {
    if (degree <= this.degree) {
      return;
    }
    const before = 4 * this.degree;
    const after = 4 * degree;
    const larger = new Uint32Array(this.lines * TEXTURE_SLOTS * after);
    for (let slot = 0; before > 0 && slot < this.rowsUsed * ROW; slot++) {
      for (let w = 0; w < before; w++) {
        larger[slot * after + w] = this.harmonics[slot * before + w];
      }
    }
    this.harmonics = larger;
    this.degree = degree;
    this.markAll();
  }

  markAll() {
    this.dirty.fill(1);
  }

  get linesUsed() {
    return Math.ceil(this.rowsUsed / ROWS_A_LINE);
  }

  // Takes a `map` message.
  apply(map) {
    if (map.reset) {
      this.clear();
    }
    this.growDegree(map.sh_degree);
    this.antialiased = map.antialiased === true;
    let first = 0;
    for (const chunk of map.chunks) {
      this.put(map, chunk, first);
      first += chunk.count * map.wordsEach;
    }
    this.version += 1;
  }

  put(map, chunk, first) {
    const key = `${chunk.at[0]},${chunk.at[1]},${chunk.at[2]},${chunk.part}`;
    const old = this.chunks.get(key);
    if (old) {
      this.drop(key, old);
    }
    if (chunk.count === 0) {
      return;
    }
    const rows = this.takeRows(Math.ceil(chunk.count / ROW));
    const digest = this.write(map, chunk, first, rows);
    this.chunks.set(key, { at: chunk.at, cell: map.cell, count: chunk.count, rows, digest });
    this.gaussians += chunk.count;
    this.digest = (this.digest + digest) >>> 0;
  }

  drop(key, chunk) {
    this.chunks.delete(key);
    this.free.push(...chunk.rows);
    this.gaussians -= chunk.count;
    this.digest = (this.digest - chunk.digest) >>> 0;
    this.mirror({ type: "drop", rows: chunk.rows });
  }

  takeRows(count) {
    const rows = [];
    while (rows.length < count) {
      rows.push(this.free.length > 0 ? this.free.pop() : this.rowsUsed++);
    }
    this.growLines(this.linesUsed);
    return rows;
  }

  // Copies a chunk's words into its rows; gives the sum of its words.
  write(map, chunk, first, rows) {
    const { words, wordsEach } = map;
    const extra = wordsEach - BASE_WORDS_EACH;
    const stride = 4 * this.degree;
    const scale = halfOf(chunk.sh_scale) << 16;
    const copy = new Uint32Array(chunk.count * BASE_WORDS_EACH);
    let digest = 0;
    for (let i = 0; i < chunk.count; i++) {
      const slot = rows[(i / ROW) | 0] * ROW + (i % ROW);
      const from = first + i * wordsEach;
      const to = slot * BASE_WORDS_EACH;
      for (let w = 0; w < BASE_WORDS_EACH; w++) {
        const word = words[from + w];
        digest = (digest + word) | 0;
        this.base[to + w] = word;
        copy[i * BASE_WORDS_EACH + w] = word;
      }
      // The high half of word 7 is free: the chunk's scale of harmonics travels there.
      this.base[to + 7] = (words[from + 7] & 0xffff) | scale;
      for (let w = 0; w < stride; w++) {
        const word = w < extra ? words[from + BASE_WORDS_EACH + w] : 0;
        digest = (digest + word) | 0;
        this.harmonics[slot * stride + w] = word;
      }
    }
    for (const row of rows) {
      this.dirty[(row / ROWS_A_LINE) | 0] = 1;
    }
    this.mirror({ type: "put", rows, count: chunk.count, words: copy }, [copy.buffer]);
    return digest >>> 0;
  }

  // Calls `upload(first, end)` for each run of texture lines that has changed.
  takeDirty(upload) {
    for (let line = 0; line < this.lines; line++) {
      if (this.dirty[line]) {
        const first = line;
        while (line < this.lines && this.dirty[line]) {
          this.dirty[line] = 0;
          line += 1;
        }
        upload(first, line);
      }
    }
  }

  // Centre of each chunk, with the number of its Gaussians.
  *centers() {
    for (const { at, cell, count } of this.chunks.values()) {
      if (cell > 0) {
        yield { center: at.map(v => (v + 0.5) * cell), count, half: cell / 2 };
      }
    }
  }
}
