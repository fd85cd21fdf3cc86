/** Checked access to arrays. */

/** Return the element at `index`. Throws a RangeError if there is none. */
export function at<T>(values: ArrayLike<T>, index: number): T {
  const found = values[index];
  if (found === undefined) throw new RangeError(`Index ${index} is outside an array of ${values.length} elements.`);
  return found;
}
