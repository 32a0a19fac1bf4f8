/** Which rows of a long list are within its window: rows have one of several heights. */
export class Rows {
  /** Top of each row, and the bottom of the last. */
  private readonly tops: Float64Array;

  /** @param heights Of the rows, in pixels. */
  constructor(heights: readonly number[]) {
    this.tops = new Float64Array(heights.length + 1);
    heights.forEach((height, i) => (this.tops[i + 1] = this.tops[i] + height));
  }

  get count(): number {
    return this.tops.length - 1;
  }

  /** Height of all rows. */
  get height(): number {
    return this.tops[this.count];
  }

  top(row: number): number {
    return this.tops[row];
  }

  bottom(row: number): number {
    return this.tops[row + 1];
  }

  /** The row at a place; the first or the last for a place beyond them. */
  at(place: number): number {
    let [low, high] = [0, this.count - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.tops[middle] <= place) low = middle;
      else high = middle - 1;
    }
    return Math.max(low, 0);
  }

  /** The first and the last row + 1 that meet a window, with `more` rows on both sides. */
  within(from: number, to: number, more: number): [number, number] {
    if (this.count === 0) return [0, 0];
    return [Math.max(this.at(from) - more, 0), Math.min(this.at(to) + 1 + more, this.count)];
  }
}
