// The splines of a long clip in chunks of time: fetched shortly before they are played, and forgotten again.

const AHEAD = 2; // chunks that are asked for before they are played
const KEPT = 6; // chunks

class Chunks {
  constructor({ curves: { chunk, points, layout } }, source, changed) {
    this.layout = layout;
    this.count = Math.ceil((points - 3) / chunk);
    this.held = new Map(); // lists by number; those used last are at the end
    this.parts = new Parts(source, (name, blob) => this.take(parseInt(name), blob), changed);
  }

  // The lists of a chunk; undefined while they are on their way.
  at(number) {
    const lists = this.held.get(number);
    if (lists) this.keep(number, lists);
    const length = lists ? Math.min(AHEAD + 1, this.count) : 1; // what is played first has the line for itself
    const soon = Array.from({ length }, (_, i) => (number + i) % this.count);
    this.parts.want(soon.filter((one) => !this.held.has(one)).map((one) => `${one}.bin`));
    return lists;
  }

  async take(number, blob) {
    this.keep(number, await listsOf(this.layout, blob));
    const [oldest] = this.held.keys();
    if (this.held.size > KEPT) this.held.delete(oldest);
  }

  keep(number, lists) {
    this.held.delete(number);
    this.held.set(number, lists);
  }
}
