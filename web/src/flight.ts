/** A flight past the cameras: level, smooth, and back again, until the user takes over. */

import { at } from "./arrays";
import { poseOf } from "./camera";
import type { Pose } from "./camera";
import type { SceneCamera } from "./format";
import { add, dot, lookingAlong, norm, scale, subtract } from "./math";
import type { Vec3 } from "./math";
import { element } from "./page";
import type { Viewer } from "./viewer";

/** Largest number of cameras that the flight follows; photographs taken by hand make it shake. */
const MOST_STOPS = 16;
/** Largest number of cameras that are put into a tour: its time grows with their square. */
const MOST_CAMERAS = 500;
/** Milliseconds from one of them to the next. */
const STEP = 2500;

/** Return the poses of some cameras in a short tour, which begins at an end and goes on to the nearest one. */
export function tourOf(cameras: readonly SceneCamera[]): readonly Pose[] {
  const left = thinned(cameras, MOST_CAMERAS).map(({ viewmat }) => {
    const pose = poseOf(viewmat, 1);
    return { ...pose, focus: Math.max(-dot(pose.position, pose.rotation[2]), 0.2) };
  });
  const middle = scale(
    left.reduce<Vec3>((sum, { position }) => add(sum, position), [0, 0, 0]),
    1 / Math.max(left.length, 1),
  );
  const tour: Pose[] = [];
  while (left.length > 0) {
    const last = tour.at(-1);
    // The farthest from the middle first, then the nearest to the last one.
    const cost = ({ position }: Pose): number =>
      last === undefined ? -norm(subtract(position, middle)) : norm(subtract(position, last.position));
    const next = left.reduce((best, _, i) => (cost(at(left, i)) < cost(at(left, best)) ? i : best), 0);
    tour.push(...left.splice(next, 1));
  }
  return thinned(tour, MOST_STOPS);
}

/** Return every k-th value, so that there are at most so many. */
function thinned<T>(values: readonly T[], most: number): T[] {
  const every = Math.ceil(values.length / most);
  return values.filter((_, i) => i % every === 0);
}

/** Return the view at a time in stops, which a uniform cubic B-spline passes closely; it goes back after the last. */
export function poseAt(stops: readonly Pose[], time: number, up: Vec3): Pose {
  const end = stops.length - 1;
  const there = end - Math.abs((time % (2 * end)) - end);
  const from = Math.floor(there);
  const f = there - from;
  const weights = [(1 - f) ** 3, 3 * f ** 3 - 6 * f ** 2 + 4, -3 * f ** 3 + 3 * f ** 2 + 3 * f + 1, f ** 3];
  const near = weights.map((_, k) => at(stops, Math.min(Math.max(from + k - 1, 0), end)));
  const mean = (of: (pose: Pose) => Vec3): Vec3 =>
    near.reduce<Vec3>((sum, pose, k) => add(sum, scale(of(pose), at(weights, k) / 6)), [0, 0, 0]);
  return {
    position: mean(({ position }) => position),
    rotation: lookingAlong(
      mean(({ rotation }) => rotation[2]),
      up,
    ),
    focus: mean(({ focus }) => [focus, 0, 0])[0],
  };
}

/** The button that starts and stops the flight. */
export class Flight {
  isOn = false;
  /** Handler called when the flight begins or ends. */
  onChange: () => void = () => undefined;
  private readonly viewer: Viewer;
  private readonly button = element("fly", HTMLButtonElement);
  private stops: readonly Pose[] = [];
  private time = 0;

  constructor(viewer: Viewer) {
    this.viewer = viewer;
    this.button.addEventListener("click", () => (this.isOn ? this.stop() : this.start()));
    for (const kind of ["pointerdown", "wheel", "keydown"] as const) {
      viewer.canvas.addEventListener(kind, () => this.stop(), { passive: true });
    }
  }

  /** Take the cameras of a scene. */
  begin(cameras: readonly SceneCamera[]): void {
    this.stops = tourOf(cameras);
    this.button.hidden = this.stops.length < 2;
  }

  start(): void {
    if (this.stops.length < 2 || this.isOn) return;
    this.tell(true);
    let before = performance.now();
    const step = (now: number): void => {
      if (!this.isOn) return;
      this.time += Math.min(Math.max(now - before, 0), 100) / STEP;
      before = now;
      this.viewer.move(poseAt(this.stops, this.time, this.viewer.up));
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  stop(): void {
    if (this.isOn) this.tell(false);
  }

  private tell(isOn: boolean): void {
    this.isOn = isOn;
    this.button.textContent = isOn ? "Stop" : "Fly";
    this.onChange();
  }
}
