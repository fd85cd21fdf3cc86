/** WebGL 2 building blocks: programs, arrays in textures, offscreen targets. */

import { SceneError } from "./format";

export const CONTEXT_LOST =
  "The connection to the GPU was lost, possibly because its memory is full. Reload the page to try again.";

/** A linked program with a cache of uniform locations. */
export class Program {
  readonly handle: WebGLProgram;
  private readonly gl: WebGL2RenderingContext;
  private readonly places = new Map<string, WebGLUniformLocation | null>();

  constructor(gl: WebGL2RenderingContext, vertex: string, fragment: string) {
    this.gl = gl;
    this.handle = gl.createProgram();
    for (const [kind, text] of [
      [gl.VERTEX_SHADER, vertex],
      [gl.FRAGMENT_SHADER, fragment],
    ] as const) {
      const shader = gl.createShader(kind);
      if (shader === null) throw new Error("WebGL could not create a shader.");
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (gl.getShaderParameter(shader, gl.COMPILE_STATUS) !== true && !gl.isContextLost()) {
        throw new Error(`The graphics driver rejected a shader: ${gl.getShaderInfoLog(shader) ?? ""}`);
      }
      gl.attachShader(this.handle, shader);
    }
    gl.linkProgram(this.handle);
    if (gl.getProgramParameter(this.handle, gl.LINK_STATUS) !== true && !gl.isContextLost()) {
      throw new Error(`The graphics driver rejected a program: ${gl.getProgramInfoLog(this.handle) ?? ""}`);
    }
  }

  at(name: string): WebGLUniformLocation | null {
    let place = this.places.get(name);
    if (place === undefined) {
      place = this.gl.getUniformLocation(this.handle, name);
      this.places.set(name, place);
    }
    return place;
  }
}

/** An append-only array in a 2D texture, four words a texel. */
export class LongTexture {
  readonly handle: WebGLTexture;
  private readonly gl: WebGL2RenderingContext;
  private readonly width: number;
  private place = 0;

  /** Allocate `num` texels in rows of 2^widthBits. Throws a SceneError if the GPU's limit is lower. */
  constructor(gl: WebGL2RenderingContext, num: number, widthBits: number, what: string) {
    this.gl = gl;
    // All limits of a lost context are null.
    if (gl.isContextLost()) throw new SceneError(CONTEXT_LOST);
    this.width = 1 << widthBits;
    const height = Math.max(Math.ceil(num / this.width), 1);
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE) as number;
    if (height > most) throw new SceneError(`The scene has more ${what} than this GPU supports.`);
    this.handle = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.handle);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, this.width, height);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
  }

  /** Append from the start again. */
  clear(): void {
    this.place = 0;
  }

  /** Append [n, 4] words. */
  append(data: Uint32Array): void {
    const { gl, width } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.handle);
    let done = 0;
    const num = data.length / 4;
    while (done < num) {
      const x = this.place % width;
      const y = Math.floor(this.place / width);
      const columns = x > 0 || num - done < width ? Math.min(width - x, num - done) : width;
      const lines = columns === width ? Math.floor((num - done) / width) : 1;
      const piece = data.subarray(4 * done, 4 * (done + columns * lines));
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, columns, lines, gl.RGBA_INTEGER, gl.UNSIGNED_INT, piece);
      done += columns * lines;
      this.place += columns * lines;
    }
  }

  delete(): void {
    this.gl.deleteTexture(this.handle);
  }
}

/** Names of drivers that draw in software. */
const SOFTWARE = /SwiftShader|llvmpipe|softpipe|Basic Render/i;

/** An offscreen picture: half floats if the GPU can draw to them, else bytes. In software, floats are faster. */
export class Target {
  width = 0;
  height = 0;
  readonly framebuffer: WebGLFramebuffer;
  texture: WebGLTexture | null = null;
  private readonly gl: WebGL2RenderingContext;
  /** Whether the picture holds floats or half floats, which are not clamped to [0, 1]. */
  readonly isFloat: boolean;
  private readonly format: GLenum;

  constructor(gl: WebGL2RenderingContext) {
    this.gl = gl;
    this.framebuffer = gl.createFramebuffer();
    const isFloat = gl.getExtension("EXT_color_buffer_float") !== null;
    this.isFloat = isFloat || gl.getExtension("EXT_color_buffer_half_float") !== null;
    const names = gl.getExtension("WEBGL_debug_renderer_info");
    const driver = String(gl.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER));
    const isSingle = isFloat && SOFTWARE.test(driver) && gl.getExtension("EXT_float_blend") !== null;
    this.format = isSingle ? gl.RGBA32F : this.isFloat ? gl.RGBA16F : gl.RGBA8;
  }

  resize(width: number, height: number): void {
    if (width === this.width && height === this.height) return;
    const { gl } = this;
    gl.deleteTexture(this.texture);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
    [this.width, this.height] = [width, height];
  }

  /** Read a rectangle as [h, w, 4], rows from the top: red, green, blue (or the mode's values), alpha. */
  read(x: number, y: number, width: number, height: number): Float32Array {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    const found = new Float32Array(4 * width * height);
    if (this.isFloat) {
      gl.readPixels(x, y, width, height, gl.RGBA, gl.FLOAT, found);
      return found;
    }
    const bytes = new Uint8Array(found.length);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return Float32Array.from(bytes, (byte) => byte / 255);
  }
}

/** Takes the time of commands without waiting for them. */
export class Stopwatch {
  private readonly gl: WebGL2RenderingContext;
  private sync: WebGLSync | null = null;
  private since = 0;

  constructor(gl: WebGL2RenderingContext) {
    this.gl = gl;
  }

  get isRunning(): boolean {
    return this.sync !== null;
  }

  /** Run until the GPU has executed `commands`. */
  start(commands: () => void): void {
    const { gl } = this;
    this.since = performance.now();
    commands();
    this.sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  /** Return the milliseconds that the commands took, once they are executed. */
  take(): number | null {
    const { gl, sync } = this;
    if (sync === null || gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) return null;
    gl.deleteSync(sync);
    this.sync = null;
    return performance.now() - this.since;
  }
}
