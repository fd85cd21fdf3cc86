/** The crop box in the scene: its edges, and a handle on each face. */

import { at } from "./arrays";
import { projection } from "./camera";
import type { Lens, Pose } from "./camera";
import { placeAt, shareAt, uprightAxes } from "./extent";
import type { Crop, Extent } from "./extent";
import { add, dot, scale, subtract } from "./math";
import type { Mat3, Row4, Vec2, Vec3 } from "./math";
import { element } from "./page";
import type { Viewer } from "./viewer";

const SVG = "http://www.w3.org/2000/svg";
/** Share of the box by which a key moves a face, and the least distance of two faces. */
const [STEP, LEAST] = [0.01, 0.005];
/** Pixels from the edge of the canvas within which no handle is. */
const MARGIN = 14;
/** Smallest depth that is drawn, over the distance of the target. */
const NEAREST = 0.02;
/** Number of places that are tried for a handle between its face and the middle. */
const NUM_PLACES = 64;
const NAMES = ["Width", "Depth", "Height"] as const;
type Axis = 0 | 1 | 2;

/** A box whose sides are along axes, one a row. */
export interface Box {
  readonly axes: Mat3;
  readonly low: Vec3;
  readonly high: Vec3;
}

/** Return the box of a crop. Faces that cut nothing are at the ends of the sliders. */
export function boxOf(extent: Extent, up: Vec3, { from, to }: Crop): Box {
  const axes = uprightAxes(up);
  const places = ([x, y, z]: Vec3): Vec3 => [
    placeAt(extent, axes[0], x),
    placeAt(extent, axes[1], y),
    placeAt(extent, axes[2], z),
  ];
  return { axes, low: places(from), high: places(to) };
}

/** Return the world's point at places along the axes of a box. */
function pointOf({ axes }: Box, [x, y, z]: Vec3): Vec3 {
  return add(add(scale(axes[0], x), scale(axes[1], y)), scale(axes[2], z));
}

function pixelOf(point: Vec3, rows: readonly [Row4, Row4, Row4]): Vec3 {
  const [x, y, z] = rows.map((row) => row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]);
  return [(x ?? 0) / (z ?? 1), (y ?? 0) / (z ?? 1), z ?? 0];
}

/** Return the twelve edges of a box in pixels, without what is nearer than `nearest`. */
export function edgesOf(box: Box, pose: Pose, lens: Lens, nearest: number): readonly (readonly [Vec2, Vec2])[] {
  const rows = projection(pose, lens);
  const depth = (point: Vec3): number => dot(subtract(point, pose.position), pose.rotation[2]);
  const corner = (bits: number): Vec3 => {
    const end = (k: Axis): number => (bits & (1 << k) ? box.high[k] : box.low[k]);
    return pointOf(box, [end(0), end(1), end(2)]);
  };
  const edges: (readonly [Vec2, Vec2])[] = [];
  for (let bits = 0; bits < 8; bits++) {
    for (const k of [0, 1, 2]) {
      if (bits & (1 << k)) continue;
      let [start, end] = [corner(bits), corner(bits | (1 << k))];
      if (depth(start) > depth(end)) [start, end] = [end, start];
      if (depth(end) <= nearest) continue;
      if (depth(start) < nearest) {
        const share = (nearest - depth(start)) / (depth(end) - depth(start));
        start = add(start, scale(subtract(end, start), share));
      }
      const [a, b] = [pixelOf(start, rows), pixelOf(end, rows)];
      edges.push([
        [a[0], a[1]],
        [b[0], b[1]],
      ]);
    }
  }
  return edges;
}

/**
 * Return the pixel of a face's handle; null if it is nowhere on the canvas. It is in the middle of the face or, if that is
 * not on the canvas, at the first place that is on the way from there to the middle of the box.
 */
export function handleOf(box: Box, k: Axis, isHigh: boolean, pose: Pose, lens: Lens, nearest: number): Vec2 | null {
  const rows = projection(pose, lens);
  const middle = scale(add(box.low, box.high), 0.5);
  const face = (isHigh ? box.high : box.low)[k];
  for (let i = 0; i < NUM_PLACES; i++) {
    const place = face + ((middle[k] - face) * i) / NUM_PLACES;
    const [x, y, z] = pixelOf(pointOf(box, replaced(middle, k, place)), rows);
    const isAcross = x >= MARGIN && x <= lens.width - MARGIN;
    if (z > nearest && isAcross && y >= MARGIN && y <= lens.height - MARGIN) return [x, y];
  }
  return null;
}

/**
 * Return the place along an axis, through the middle of a box, that is nearest to what a pixel shows; null if the axis
 * points at the camera.
 */
export function placeUnder(box: Box, k: Axis, pose: Pose, lens: Lens, [x, y]: Vec2): number | null {
  const [right, down, forward] = pose.rotation;
  const v = (y - lens.cy) / lens.fy;
  const u = (x - lens.cx - lens.skew * v) / lens.fx;
  const ray = add(add(scale(right, u), scale(down, v)), forward);
  const axis = box.axes[k];
  const middle = scale(add(box.low, box.high), 0.5);
  const offset = subtract(pointOf(box, replaced(middle, k, 0)), pose.position);
  const [slope, length] = [dot(axis, ray), dot(ray, ray)];
  const rest = length - slope * slope;
  if (rest < 1e-3 * length) return null;
  return (slope * dot(ray, offset) - length * dot(axis, offset)) / rest;
}

/** Return a crop with another face, which stays on its side of the opposite one. */
export function withFace({ from, to }: Crop, k: Axis, isHigh: boolean, share: number): Crop {
  if (isHigh) return { from, to: replaced(to, k, Math.min(Math.max(share, from[k] + LEAST), 1)) };
  return { from: replaced(from, k, Math.max(Math.min(share, to[k] - LEAST), 0)), to };
}

function replaced([x, y, z]: Vec3, k: Axis, value: number): Vec3 {
  return [k === 0 ? value : x, k === 1 ? value : y, k === 2 ? value : z];
}

interface Handle {
  readonly k: Axis;
  readonly isHigh: boolean;
  readonly circle: SVGCircleElement;
}

/** Draws the box over the canvas while its sliders are open, and moves its faces by pointer and keys. */
export class BoxHandles {
  /** Handler called with another crop. */
  onCrop: (crop: Crop) => void = () => undefined;
  private readonly viewer: Viewer;
  private readonly section = element("cropping", HTMLDetailsElement);
  private readonly picture: SVGSVGElement;
  private readonly path: SVGPathElement;
  private readonly handles: readonly Handle[];

  constructor(viewer: Viewer) {
    this.viewer = viewer;
    this.picture = document.createElementNS(SVG, "svg");
    this.picture.id = "box";
    this.path = document.createElementNS(SVG, "path");
    this.picture.append(this.path);
    this.handles = ([0, 1, 2] as const).flatMap((k) => [false, true].map((isHigh) => this.handle(k, isHigh)));
    viewer.canvas.after(this.picture);
    this.section.addEventListener("toggle", () => this.place());
    this.place();
  }

  /** Draw the box where the view shows it. */
  place(): void {
    const { viewer, picture } = this;
    const isShown = this.section.open && viewer.splats !== null;
    picture.style.display = isShown ? "" : "none";
    if (!isShown) return;
    const { pose, lens, crop } = viewer;
    const nearest = NEAREST * pose.focus;
    const edges = edgesOf(this.box, pose, lens, nearest);
    const text = ([x, y]: Vec2): string => `${x.toFixed(1)} ${y.toFixed(1)}`;
    this.path.setAttribute("d", edges.map(([a, b]) => `M${text(a)}L${text(b)}`).join(""));
    for (const { k, isHigh, circle } of this.handles) {
      const found = handleOf(this.box, k, isHigh, pose, lens, nearest);
      circle.style.display = found === null ? "none" : "";
      circle.setAttribute("cx", String(found?.[0] ?? 0));
      circle.setAttribute("cy", String(found?.[1] ?? 0));
      circle.setAttribute("aria-valuenow", (100 * (isHigh ? crop.to : crop.from)[k]).toFixed(0));
    }
  }

  private get box(): Box {
    return boxOf(this.viewer.box, this.viewer.up, this.viewer.crop);
  }

  private handle(k: Axis, isHigh: boolean): Handle {
    const circle = document.createElementNS(SVG, "circle");
    const texts = { r: "8", tabindex: "0", role: "slider", "aria-valuemin": "0", "aria-valuemax": "100" };
    for (const [name, value] of Object.entries(texts)) circle.setAttribute(name, value);
    circle.setAttribute("aria-label", `${at(NAMES, k)}, ${isHigh ? "to" : "from"}, of the box`);
    circle.addEventListener("pointerdown", (event) => circle.setPointerCapture(event.pointerId));
    circle.addEventListener("pointermove", (event) => {
      if (circle.hasPointerCapture(event.pointerId)) this.drag(k, isHigh, event);
    });
    circle.addEventListener("keydown", (event) => this.press(k, isHigh, event));
    this.picture.append(circle);
    return { k, isHigh, circle };
  }

  private drag(k: Axis, isHigh: boolean, event: PointerEvent): void {
    const { viewer } = this;
    const { left, top } = viewer.canvas.getBoundingClientRect();
    const pixel: Vec2 = [event.clientX - left, event.clientY - top];
    const place = placeUnder(this.box, k, viewer.pose, viewer.lens, pixel);
    if (place !== null) this.move(k, isHigh, shareAt(viewer.box, this.box.axes[k], place));
  }

  private press(k: Axis, isHigh: boolean, event: KeyboardEvent): void {
    const by = { ArrowLeft: -STEP, ArrowDown: -STEP, ArrowRight: STEP, ArrowUp: STEP }[event.key];
    if (by === undefined) return;
    event.preventDefault();
    const { crop } = this.viewer;
    this.move(k, isHigh, (isHigh ? crop.to : crop.from)[k] + by);
  }

  private move(k: Axis, isHigh: boolean, share: number): void {
    this.onCrop(withFace(this.viewer.crop, k, isHigh, share));
  }
}
