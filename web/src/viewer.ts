/** The viewer: a scene, the current view of it, and when to redraw the canvas. */

import { at } from "./arrays";
import { aimed, fitted, lensOf, overview, poseOf, projection } from "./camera";
import type { Fit, Lens, Pose } from "./camera";
import { Controls } from "./controls";
import type { Steered } from "./controls";
import { WHOLE, clipOf, extentOf } from "./extent";
import type { Clip, Crop, Extent } from "./extent";
import { SceneError } from "./format";
import type { Header, SceneCamera } from "./format";
import { Stopwatch } from "./gl";
import { add, dot, scale } from "./math";
import type { Row4, Vec2, Vec3 } from "./math";
import { Renderer } from "./renderer";
import type { Shown } from "./renderer";
import { BATCH } from "./shaders";
import type { Mode } from "./shaders";
import { Splats } from "./splats";
import { verticalOf } from "./vertical";

/** Milliseconds that a picture may take in motion, and a slice of one at rest. */
const BUDGET = 50;
/** Smallest share of the pixels of a side. */
const COARSEST = 0.25;
/** Milliseconds after the last motion until pictures become finer. */
const REST = 160;
/** Lens for scenes without cameras: 53° across the narrower side. */
const FREE_LENS: Lens = { fx: 600, fy: 600, cx: 300, cy: 300, skew: 0, width: 600, height: 600 };
const UNIT: Extent = { centre: [0, 0, 0], half: [1, 1, 1] };

/** A picture that is drawn in slices of splats, from the farthest to the nearest. */
interface Painting {
  readonly shown: Shown;
  /** Share of the pixels of a side. */
  readonly share: number;
  /** Number of splats drawn so far. */
  num: number;
}

/** A slice whose time is taken: its shares of the splats and of the pixels of a side. */
interface Slice {
  readonly splats: number;
  readonly pixels: number;
}

export class Viewer implements Steered {
  readonly canvas: HTMLCanvasElement;
  splats: Splats | null = null;
  pose: Pose = overview(UNIT, [0, 0, 1], FREE_LENS);
  /** Lens of the current view. */
  image: Lens = FREE_LENS;
  /** How the image of that lens fits the canvas, which may show more around it. */
  fit: Fit = "whole";
  up: Vec3 = [0, 0, 1];
  /** Whether the user has chosen the vertical. */
  isUpChosen = false;
  extent = 1;
  crop: Crop = WHOLE;
  /** Strictness with which floaters are hidden, 0 to 1. */
  floaters = 0;
  /** Whether only the subject is shown. */
  isAlone = false;
  /** The background that the user has chosen; null shows the scene's own. */
  background: Vec3 | null = null;
  /** Stops by which colours are brighter. */
  exposure = 0;
  mode: Mode = "full";
  /** Share of the width left of which textures are shown; null shows them everywhere. */
  divided: number | null = null;
  /** Handler called after each frame. */
  onFrame: () => void = () => undefined;
  /** Handler called when the scene cannot be drawn. */
  onFail: (reason: string) => void = () => undefined;
  /** Handler called when the user has moved the camera. */
  onLeave: () => void = () => undefined;

  private readonly gl: WebGL2RenderingContext;
  private readonly renderer: Renderer;
  private readonly watch: Stopwatch;
  private timed: Slice = { splats: 1, pixels: 1 };
  /** Milliseconds that a picture of all pixels takes, at most. */
  private cost = Infinity;
  private isSlow = false;
  private painting: Painting | null = null;
  private isStale = true;
  private isWaiting = false;
  private movedAt = -Infinity;

  /** Throws a SceneError if the browser has no WebGL 2. */
  constructor(canvas: HTMLCanvasElement) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
    if (gl === null) {
      throw new SceneError(
        "This browser has no WebGL 2, which the viewer needs. Turn on hardware acceleration in its settings, or try " +
          "another browser.",
      );
    }
    this.gl = gl;
    this.renderer = new Renderer(gl);
    this.watch = new Stopwatch(gl);
    new Controls(canvas, this);
    new ResizeObserver(() => this.draw()).observe(canvas);
    this.watchRatio();
  }

  /** Start a scene, which replaces the current one once it is completely sorted. */
  begin(header: Header): Splats {
    const splats = new Splats(this.gl, header);
    splats.onOrder = () => {
      if (this.splats !== splats && splats.numDrawn === header.num) {
        this.splats?.delete();
        this.splats = splats;
      }
      this.draw();
    };
    splats.onFail = (reason) => this.onFail(reason);
    return splats;
  }

  /** Sort a scene for the current view. */
  sort(splats: Splats): void {
    splats.sort(this.depthRow);
  }

  /** Go to the camera that shows the front, or to where most of the scene is seen, with the vertical of the cameras. */
  settle({ header }: Splats): void {
    const first = header.cameras.at(header.first);
    const extent = extentOf(header.means);
    [this.up, this.isUpChosen, this.exposure] = [verticalOfScene(header), false, 0];
    this.extent = first !== undefined ? 1 : Math.max(...extent.half);
    if (first !== undefined) {
      this.goTo(first, "close");
      return;
    }
    [this.image, this.fit] = [FREE_LENS, "close"];
    this.pose = overview(extent, this.up, this.lens);
  }

  goTo(camera: SceneCamera, fit: Fit = "whole"): void {
    [this.image, this.fit] = [lensOf(camera.K, camera.size), fit];
    const pose = poseOf(camera.viewmat, 1);
    // Cameras carry no target: use the point on the optical axis nearest to the origin, the middle of the scene.
    this.pose = { ...pose, focus: Math.max(-dot(pose.position, pose.rotation[2]), 0.2 * this.extent) };
    this.draw();
  }

  /** Lens for the canvas, in CSS pixels. */
  get lens(): Lens {
    const { clientWidth, clientHeight } = this.canvas;
    return fitted(this.image, Math.max(clientWidth, 1), Math.max(clientHeight, 1), this.fit);
  }

  /** Set the vertical; null takes the scene's. */
  chooseUp(up: Vec3 | null): void {
    [this.up, this.isUpChosen] = [up ?? this.ownUp, up !== null];
    this.draw();
  }

  onMove(): void {
    this.onLeave();
    this.move(this.pose);
  }

  /** Show another view, in motion. */
  move(pose: Pose): void {
    this.pose = pose;
    this.movedAt = performance.now();
    this.draw();
  }

  /** Make the surface at a point of the canvas the target. */
  onAim(x: number, y: number): void {
    const { lens, splats } = this;
    if (splats === null) return;
    this.renderer.draw(splats, { pose: this.pose, lens, clip: this.clip, mode: "depth" });
    const column = Math.min(Math.max(Math.floor(x), 0), lens.width - 1);
    const row = Math.min(Math.max(Math.floor(y), 0), lens.height - 1);
    const pixel = this.renderer.target.read(column, row, 1, 1);
    const [depth, alpha] = [at(pixel, 0), at(pixel, 3)];
    if (alpha > 0.1) {
      const z = depth / alpha;
      const [right, down, forward] = this.pose.rotation;
      const across = scale(right, ((x - lens.cx) / lens.fx) * z);
      const below = scale(down, ((y - lens.cy) / lens.fy) * z);
      this.pose = aimed(this.pose, add(this.pose.position, add(add(across, below), scale(forward, z))));
    }
    this.onMove();
  }

  /** Request a new picture. */
  draw(): void {
    this.isStale = true;
    this.request();
  }

  /** Render a view to [h, w, 4], rows from the top: premultiplied colours and alpha. */
  async read(pose: Pose, lens: Lens, mode: Mode): Promise<Float32Array> {
    const { splats } = this;
    if (splats === null) throw new SceneError("No scene is loaded yet.");
    await splats.sortNow(projection(pose, lens)[2]);
    this.renderer.draw(splats, { pose, lens, clip: this.clip, mode });
    const found = this.renderer.target.read(0, 0, lens.width, lens.height);
    this.draw();
    return found;
  }

  get clip(): Clip {
    const isAlone = this.isAlone && this.splats?.header.hasSubject === true;
    return clipOf(this.box, this.up, this.crop, this.floaters, isAlone);
  }

  /** Extent of the scene. */
  get box(): Extent {
    return this.splats === null ? UNIT : extentOf(this.splats.header.means);
  }

  private get ownUp(): Vec3 {
    return this.splats === null ? this.up : verticalOfScene(this.splats.header);
  }

  private get depthRow(): Row4 {
    return projection(this.pose, this.lens)[2];
  }

  /** Draw again when the window goes to a screen of other pixels, which leaves its size as it is. */
  private watchRatio(): void {
    matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`).addEventListener(
      "change",
      () => {
        this.draw();
        this.watchRatio();
      },
      { once: true },
    );
  }

  private request(): void {
    if (this.isWaiting) return;
    this.isWaiting = true;
    requestAnimationFrame(() => this.frame());
  }

  private frame(): void {
    this.isWaiting = false;
    const { splats, watch } = this;
    if (splats === null || this.gl.isContextLost()) return;
    splats.sort(this.depthRow);
    const spent = watch.take();
    if (spent !== null) {
      this.cost = spent / (this.timed.splats * this.timed.pixels ** 2);
      this.isSlow = spent > BUDGET / 2;
    }
    const isMoving = performance.now() - this.movedAt < REST;
    // What is slow is waited for: nothing that the user does next shall queue behind several pictures.
    const isReady = !(watch.isRunning && this.isSlow);
    if (isReady && (this.isStale || (!isMoving && this.painting !== null))) this.paint(splats, isMoving);
    if (isMoving || watch.isRunning || this.isStale || this.painting !== null) this.request();
  }

  /** Draw a picture or, at rest, a slice of it. */
  private paint(splats: Splats, isMoving: boolean): void {
    const { watch } = this;
    if (this.isStale || this.painting === null) this.painting = this.begun(this.coarseness);
    this.isStale = false;
    const { painting } = this;
    const { shown, share, num } = painting;
    const all = splats.numDrawn;
    const slice = Math.max((all * BUDGET) / (this.cost * share ** 2), BATCH);
    // A last slice of less than half a slice is drawn with the one before.
    const end = isMoving || all - num < 1.5 * slice ? all : Math.min(num + Math.ceil(slice), all);
    const isLast = end === all;
    const commands = (): void => {
      this.renderer.draw(splats, shown, num, end);
      if (isLast) this.present(splats, shown);
    };
    if (watch.isRunning) commands();
    else {
      this.timed = { splats: Math.max(end - num, 1) / Math.max(all, 1), pixels: share };
      watch.start(commands);
    }
    painting.num = end;
    if (isLast) this.painting = share < 1 ? this.begun(Math.min(2 * share, 1)) : null;
  }

  private begun(share: number): Painting {
    const { canvas, clip, mode, divided, pose } = this;
    const scale = share * Math.min(window.devicePixelRatio, 2);
    const width = Math.max(Math.round(canvas.clientWidth * scale), 1);
    const height = Math.max(Math.round(canvas.clientHeight * scale), 1);
    const lens = fitted(this.image, width, height, this.fit);
    return { shown: { pose, lens, clip, mode, divided }, share, num: 0 };
  }

  private present(splats: Splats, { lens: { width, height } }: Shown): void {
    const { canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const { mode, depths, divided } = this;
    const gain = mode === "full" || mode === "plain" ? 2 ** this.exposure : 1;
    this.renderer.present(this.background ?? splats.header.background, mode, depths, divided, gain);
    this.onFrame();
  }

  /** Share of the pixels of a side that can be drawn within the budget, in few steps, as a canvas loses its picture with its size. */
  private get coarseness(): number {
    const share = Math.sqrt(BUDGET / this.cost);
    return Math.min(Math.max(2 ** (Math.floor(2 * Math.log2(share)) / 2), COARSEST), 1);
  }

  /** Nearest and farthest depth of the depth mode's colour ramp. */
  private get depths(): Vec2 {
    return [0.3 * this.pose.focus, 5 * this.pose.focus];
  }
}

/** Return the vertical that a scene says or its cameras have; without cameras −y, as in most point clouds. */
function verticalOfScene({ cameras, up }: Header): Vec3 {
  if (up !== null) return up;
  return cameras.length === 0 ? [0, -1, 0] : verticalOf(cameras.map(({ viewmat }) => poseOf(viewmat, 1).rotation));
}
