/** Checked access to arrays, and their concatenation. */

/** Return the element at `index`. Throws a RangeError if there is none. */
export function at<T>(values: ArrayLike<T>, index: number): T {
  const found = values[index];
  if (found === undefined) throw new RangeError(`Index ${index} is outside an array of ${values.length} elements.`);
  return found;
}

/** Return arrays one after the other. */
export function joined(pieces: readonly Uint8Array[]): Uint8Array<ArrayBuffer> {
  const found = new Uint8Array(pieces.reduce((sum, piece) => sum + piece.length, 0));
  let place = 0;
  for (const piece of pieces) {
    found.set(piece, place);
    place += piece.length;
  }
  return found;
}
