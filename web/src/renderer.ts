/** Draws sorted splats back to front into an offscreen picture, then copies it to the canvas. */

import { at } from "./arrays";
import type { Lens, Pose } from "./camera";
import { projection } from "./camera";
import type { Clip } from "./extent";
import type { Ends } from "./format";
import { Program, Target } from "./gl";
import type { Vec2, Vec3 } from "./math";
import { SUBJECT_BIT } from "./packing";
import { BATCH, MODES, SCREEN_FRAGMENT, SCREEN_VERTEX, splatFragment, splatVertex } from "./shaders";
import type { Mode, Variant } from "./shaders";
import type { Splats } from "./splats";

/** Range of columns that is drawn in one mode. */
interface Part {
  readonly mode: Mode;
  readonly from: number;
  readonly to: number;
}

/** What a picture shows. */
export interface Shown {
  readonly pose: Pose;
  readonly lens: Lens;
  readonly clip: Clip;
  readonly mode: Mode;
  /** Share of the width right of which textures are left out. */
  readonly divided?: number | null;
}

export class Renderer {
  readonly gl: WebGL2RenderingContext;
  readonly target: Target;
  private readonly splats = new Map<string, Program>();
  private readonly screen: Program;
  private readonly quads: WebGLVertexArrayObject;
  private readonly nothing: WebGLVertexArrayObject;

  /** Throws an Error if the driver rejects a shader. */
  constructor(gl: WebGL2RenderingContext) {
    this.gl = gl;
    this.target = new Target(gl);
    this.screen = new Program(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.quads = quadsOf(gl);
    this.nothing = gl.createVertexArray();
  }

  /**
   * Draw a picture at the lens' size, or continue it.
   *
   * @param start - place, in the order from the farthest to the nearest, of the first splat; 0 begins a picture
   * @param end - place behind the last splat
   */
  draw(splats: Splats, shown: Shown, start = 0, end = splats.numDrawn): void {
    const { gl, target } = this;
    const { lens, mode, divided = null } = shown;
    target.resize(lens.width, lens.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, lens.width, lens.height);
    gl.disable(gl.SCISSOR_TEST);
    if (start === 0) {
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
    }
    if (end <= start) return;
    const middle = divided === null ? lens.width : Math.round(divided * lens.width);
    const parts: Part[] = [{ mode, from: 0, to: middle }];
    if (middle < lens.width) parts.push({ mode: "plain", from: middle, to: lens.width });
    for (const part of parts) this.drawPart(splats, shown, part, start, end);
    gl.disable(gl.SCISSOR_TEST);
    gl.disable(gl.BLEND);
  }

  /** Copy the picture to the canvas. */
  present(background: Vec3, mode: Mode, depths: Vec2, divided: number | null = null, gain = 1): void {
    const { gl, screen } = this;
    const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(screen.handle);
    gl.bindVertexArray(this.nothing);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(screen.at("picture"), 0);
    gl.uniform1i(screen.at("height"), height);
    gl.uniform3fv(screen.at("background"), background);
    gl.uniform2fv(screen.at("depths"), depths);
    gl.uniform1f(screen.at("gain"), gain);
    gl.uniform1i(screen.at("mode"), MODES.indexOf(mode));
    gl.uniform1f(screen.at("divider"), divided === null ? -1 : Math.round(divided * width));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Return the program for a scene in a mode, which is compiled at the first call. */
  private programOf({ header }: Splats, mode: Mode): Program {
    const variant: Variant = {
      mode,
      degree: Math.max(...header.degrees),
      isTextured: header.numTexels > 0 && mode !== "plain",
      isShaped: header.hasShapes,
      isClamped: header.outside === "clamp",
      isCentred: header.uv === "texel-centre",
    };
    const key = JSON.stringify(variant);
    const found = this.splats.get(key) ?? new Program(this.gl, splatVertex(variant), splatFragment(variant));
    this.splats.set(key, found);
    return found;
  }

  private prepare(splat: Program, splats: Splats, { pose, lens }: Shown): void {
    const { gl } = this;
    const { header } = splats;
    gl.useProgram(splat.handle);
    gl.bindVertexArray(this.quads);
    const textures = { order: splats.order, rows: splats.rows, harmonics: splats.harmonics, texels: splats.texels };
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture.handle);
      gl.uniform1i(splat.at(name), unit);
    });
    const ends = (name: string, { low, step }: Ends): void => gl.uniform2f(splat.at(name), low, step);
    const { log_scales, quats, opacities, sh_0, sh_1, sh_2, sh_3, texel_colors, texel_alphas, shapes } = header.ends;
    ends("scaleEnds", log_scales);
    ends("quatEnds", quats);
    ends("opacityEnds", opacities);
    ends("colorEnds", texel_colors);
    ends("alphaEnds", texel_alphas);
    ends("shapeEnds", shapes);
    for (const [l, band] of [sh_0, sh_1, sh_2, sh_3].entries()) ends(`harmonicEnds[${l}]`, band);
    gl.uniform1f(splat.at("peak"), header.numTexels === 0 ? 1 : Math.max(1, texel_alphas.high));
    gl.uniform1f(splat.at("nearPlane"), header.nearPlane);
    gl.uniform1f(splat.at("maxAlpha"), header.maxAlpha);
    gl.uniform1f(splat.at("extent"), header.extent);
    gl.uniform1i(splat.at("widthBits"), splats.widthBits);
    gl.uniform4fv(splat.at("projection"), projection(pose, lens).flat());
    gl.uniform3fv(splat.at("center"), pose.position);
    gl.uniform2f(splat.at("size"), lens.width, lens.height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  private limit(splat: Program, { axes, low, high, floating, isAlone }: Clip): void {
    const { gl } = this;
    gl.uniform3fv(splat.at("boxAxes"), axes.flat());
    gl.uniform3fv(splat.at("boxLow"), low);
    gl.uniform3fv(splat.at("boxHigh"), high);
    gl.uniform1f(splat.at("floating"), floating);
    gl.uniform1ui(splat.at("wanted"), isAlone ? SUBJECT_BIT : 0);
  }

  private drawPart(splats: Splats, shown: Shown, { mode, from, to }: Part, start: number, end: number): void {
    const { gl } = this;
    if (to <= from) return;
    const program = this.programOf(splats, mode);
    this.prepare(program, splats, shown);
    this.limit(program, shown.clip);
    gl.uniform1i(program.at("start"), start);
    gl.uniform1i(program.at("end"), end);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(from, 0, to - from, shown.lens.height);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil((end - start) / BATCH));
  }
}

/** Corners of the two triangles of a quad. */
const CORNERS = [0, 1, 2, 3, 2, 1];

/** Return indices of a batch of quads. In software four successive new vertices are computed at once. */
function quadsOf(gl: WebGL2RenderingContext): WebGLVertexArrayObject {
  const found = gl.createVertexArray();
  const indices = Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + at(CORNERS, i % 6));
  gl.bindVertexArray(found);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return found;
}
