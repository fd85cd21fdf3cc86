/** States that can be taken back. */

export class History<T> {
  private past: T[] = [];
  private future: T[] = [];
  private now: T;

  constructor(now: T) {
    this.now = now;
  }

  get canUndo(): boolean {
    return this.past.length > 0;
  }

  get canRedo(): boolean {
    return this.future.length > 0;
  }

  /** Add a state, unless it equals the current one. */
  add(state: T): void {
    if (JSON.stringify(state) === JSON.stringify(this.now)) return;
    this.past.push(this.now);
    [this.now, this.future] = [state, []];
  }

  /** Return the state before; null if there is none. */
  undo(): T | null {
    return this.go(this.past, this.future);
  }

  /** Return the state that was taken back last; null if there is none. */
  redo(): T | null {
    return this.go(this.future, this.past);
  }

  private go(from: T[], to: T[]): T | null {
    const state = from.pop();
    if (state === undefined) return null;
    to.push(this.now);
    this.now = state;
    return state;
  }
}
