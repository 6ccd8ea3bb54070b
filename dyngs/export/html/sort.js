// Order of drawing: far to near, by two passes of a counting sort over the bits of the depths, which are positive
// floats and so in the order of their bits. Exact: the same order as in dyngs.

class DepthOrder {
  constructor(count) {
    this.depths = new Float32Array(count);
    this.bits = new Uint32Array(this.depths.buffer);
    this.rows = new Uint32Array(count);
    this.order = new Uint32Array(count);
    this.counts = new Uint32Array(65536);
  }

  // Returns how many are beyond `near` and, where `seen` is given, seen; `order` begins with them, the farthest first.
  sort(near, seen) {
    const { depths, bits, rows, order, counts } = this;
    let kept = 0;
    for (let i = 0; i < depths.length; ++i)
      if (depths[i] > near && depths[i] < Infinity && (!seen || (seen[i >> 3] >> (i & 7)) & 1)) order[kept++] = i;
    for (const [from, to, shift] of [[order, rows, 0], [rows, order, 16]]) {
      counts.fill(0);
      for (let i = 0; i < kept; ++i) ++counts[(bits[from[i]] >>> shift) & 65535];
      let start = 0;
      for (let k = 65535; k >= 0; --k) {
        const count = counts[k];
        counts[k] = start;
        start += count;
      }
      for (let i = 0; i < kept; ++i) to[counts[(bits[from[i]] >>> shift) & 65535]++] = from[i];
    }
    return kept;
  }
}
