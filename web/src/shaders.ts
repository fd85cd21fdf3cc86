/**
 * Shaders that draw splats as a2tg_jax/rasterize/pixel.py and a2tg_jax/core/geometry.py define them. Pictures are drawn
 * upside down, so that gl_FragCoord has the cameras' pixel coordinates: y down, centres at +0.5.
 */

export const MODES = ["full", "plain", "texture", "resolution", "depth", "normals", "ellipses"] as const;
export type Mode = (typeof MODES)[number];

/** What a program draws. It is compiled for that alone: in software, branches that are not taken cost as much. */
export interface Variant {
  readonly mode: Mode;
  /** Highest degree of the spherical harmonics. */
  readonly degree: number;
  readonly isTextured: boolean;
  /** Whether kernels differ in shape. */
  readonly isShaped: boolean;
  readonly isClamped: boolean;
  readonly isCentred: boolean;
}

/** Number of quads that an instance draws. In software every instance costs as much as a draw call. */
export const BATCH = 1024;

const HEADER = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
precision highp sampler2D;
const int FULL = 0, PLAIN = 1, TEXTURE = 2, RESOLUTION = 3, DEPTH = 4, NORMALS = 5, ELLIPSES = 6;
`;

function constantsOf({ mode, degree, isTextured, isShaped, isClamped, isCentred }: Variant): string {
  return `
const int mode = ${MODES.indexOf(mode)}, DEGREE = ${degree};
const bool isTextured = ${isTextured}, isShaped = ${isShaped}, isClamped = ${isClamped}, isCentred = ${isCentred};
`;
}

const FETCH = `
uniform int widthBits;

uvec4 wordsAt(usampler2D words, uint index) {
  return texelFetch(words, ivec2(int(index) & ((1 << widthBits) - 1), int(index >> widthBits)), 0);
}
`;

const TEXELS = `${FETCH}
uniform usampler2D texels;
uniform vec2 colorEnds, alphaEnds;

// Interpolate between the four words at an index.
vec4 texelAt(uint index, vec4 weights) {
  ivec4 words = ivec4(wordsAt(texels, index));
  vec4 code = vec4(
    dot(vec4(words & 255), weights), dot(vec4((words >> 8) & 255), weights),
    dot(vec4((words >> 16) & 255), weights), dot(vec4((words >> 24) & 255), weights));
  return vec4(colorEnds.x + code.rgb * colorEnds.y, alphaEnds.x + code.a * alphaEnds.y);
}
`;

/** Falloff of kernels with shapes: exp(-scale ((rho + OFFSET)^exponent - start)), as in a2tg_jax/appearance/parts.py. */
const KERNEL = `
const float OFFSET = 0.02, LARGEST_LOG_EXPONENT = 1.0, HALF_LOG2E = 0.7213475204444817;
`;

export const splatVertex = (variant: Variant): string => `${HEADER}${constantsOf(variant)}${TEXELS}${KERNEL}
uniform usampler2D order, rows, harmonics;
uniform int start, end;
uniform vec4 projection[3];
uniform vec3 center;
uniform vec2 size;
uniform float nearPlane, peak;
uniform vec3 boxAxes[3], boxLow, boxHigh;
uniform float floating;
uniform uint wanted;
uniform vec2 scaleEnds, quatEnds, opacityEnds, shapeEnds, harmonicEnds[4];

flat out vec4 axes;
flat out vec3 plane;
flat out vec3 mean;
flat out vec4 shown;
flat out uvec3 region;
flat out vec3 own;
flat out vec3 curve;

const float SLACK = 1e-2;

vec4 bytesOf(uint word) {
  int bits = int(word);
  return vec4(ivec4(bits, bits >> 8, bits >> 16, bits >> 24) & 255);
}

vec4 values(uint word, vec2 ends) { return ends.x + bytesOf(word) * ends.y; }

// Exponent, scale and start of the falloff of a kernel.
vec3 curveOf(float logExponent) {
  float exponent = exp(clamp(logExponent, -LARGEST_LOG_EXPONENT, LARGEST_LOG_EXPONENT));
  float start = pow(OFFSET, exponent);
  return vec3(exponent, 1.0 / (pow(2.0 + OFFSET, exponent) - start), start);
}

// Sum of the products of weights and coefficients, which a word each holds.
vec3 summed(uvec4 words, vec4 weights) {
  ivec4 bits = ivec4(words);
  return vec3(
    dot(vec4(bits & 255), weights), dot(vec4((bits >> 8) & 255), weights), dot(vec4((bits >> 16) & 255), weights));
}

vec3 colorOf(vec3 base, uint first, int degree, vec3 d) {
  vec3 sum = 0.28209479177387814 * base;
  if (DEGREE > 0 && degree > 0) {
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    vec3 one = 0.4886025119029199 * vec3(-y, z, -x);
    uvec4 words = wordsAt(harmonics, first);
    sum += harmonicEnds[1].x * dot(one, vec3(1)) + harmonicEnds[1].y * summed(words, vec4(one, 0.0));
    if (DEGREE > 1 && degree > 1) {
      vec4 two = vec4(1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy), -1.0925484305920792 * x * z);
      float last = 0.5462742152960396 * (xx - yy);
      uvec4 next = wordsAt(harmonics, first + 1u);
      sum += harmonicEnds[2].x * (dot(two, vec4(1)) + last)
        + harmonicEnds[2].y * (summed(uvec4(words.w, next.xyz), two) + last * bytesOf(next.w).rgb);
    }
    if (DEGREE > 2 && degree > 2) {
      vec4 three = vec4(-0.5900435899266435 * y * (3.0 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy), 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy));
      vec3 rest = vec3(-0.4570457994644658 * x * (4.0 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy));
      sum += harmonicEnds[3].x * (dot(three, vec4(1)) + dot(rest, vec3(1)))
        + harmonicEnds[3].y * (summed(wordsAt(harmonics, first + 2u), three)
          + summed(wordsAt(harmonics, first + 3u), vec4(rest, 0.0)));
    }
  }
  return max(sum + 0.5, 0.0);
}

// Rotation matrix, by columns, of the unit quaternion with vector part q and w >= 0.
mat3 rotationOf(vec3 q) {
  float squares = min(dot(q, q), 1.0);
  vec4 p = normalize(vec4(q, sqrt(1.0 - squares)));
  float x = p.x, y = p.y, z = p.z, w = p.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// A corner of the box around a disc that crosses the near plane.
vec2 clippedCorner(vec3 M[3], float reach, vec2 middle, float radius, vec2 side) {
  vec2 low = middle - radius, high = middle + radius;
  const int SIDES = 8;
  float r = reach / cos(3.14159265358979 / float(SIDES));
  vec3 before = vec3(0);
  for (int i = 0; i <= SIDES; i++) {
    float angle = float(i) * (2.0 * 3.14159265358979 / float(SIDES));
    vec3 uv = vec3(r * cos(angle), r * sin(angle), 1.0);
    vec3 point = vec3(dot(M[0], uv), dot(M[1], uv), dot(M[2], uv));
    bool isBefore = point.z >= nearPlane;
    if (isBefore) {
      low = min(low, point.xy / point.z);
      high = max(high, point.xy / point.z);
    }
    if (i > 0 && isBefore != (before.z >= nearPlane)) {
      vec3 cut = mix(before, point, (nearPlane - before.z) / (point.z - before.z));
      low = min(low, cut.xy / nearPlane);
      high = max(high, cut.xy / nearPlane);
    }
    before = point;
  }
  vec2 margin = 1e-3 * (high - low) + SLACK;
  return mix(max(low - margin, -1.0), min(high + margin, size + 1.0), side);
}

// A corner of the smallest rotated box around an ellipse and the low-pass filter's circle. isBeside tells whether both
// lie outside the picture.
vec2 corner(vec3 M[3], float r2, vec2 middle, float radius, vec2 side, out bool isBeside) {
  isBeside = false;
  float depth = M[2].z;
  vec2 last = M[2].xy, xs = M[0].xy - middle.x * last, ys = M[1].xy - middle.y * last;
  float spread = r2 * dot(last, last);
  if (depth - sqrt(spread) < nearPlane) return clippedCorner(M, sqrt(r2), middle, radius, side);
  float factor = r2 / (depth * depth - spread);
  vec2 shift = -factor * vec2(dot(xs, last), dot(ys, last));
  float xx = (shift.x * shift.x + factor * dot(xs, xs)) * 1.0001 + SLACK;
  float xy = (shift.x * shift.y + factor * dot(xs, ys)) * 1.0001;
  float yy = (shift.y * shift.y + factor * dot(ys, ys)) * 1.0001 + SLACK;
  vec2 centre = middle + shift, extent = sqrt(vec2(xx, yy));
  vec2 least = min(centre - extent, middle - radius), most = max(centre + extent, middle + radius);
  isBeside = any(lessThan(most, vec2(0.0))) || any(greaterThan(least, size));
  float mid = 0.5 * (xx + yy), half_ = 0.5 * (xx - yy), root = length(vec2(half_, xy));
  float angle = root > 1e-6 * mid ? 0.5 * atan(xy, half_) : 0.0;
  vec2 major = vec2(cos(angle), sin(angle)), minor = vec2(-major.y, major.x);
  vec2 reach = sqrt(vec2(mid + root, max(mid - root, 0.0))) * 1.0005 + 1e-2;
  vec2 offset = vec2(dot(-shift, major), dot(-shift, minor));
  vec2 low = min(-reach, offset - radius), high = max(reach, offset + radius);
  vec2 place = mix(low, high, side);
  return centre + place.x * major + place.y * minor;
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  int place = start + gl_InstanceID * ${BATCH} + (gl_VertexID >> 2);
  axes = vec4(0); plane = vec3(0); mean = vec3(0); shown = vec4(0); region = uvec3(0); own = vec3(0); curve = vec3(0);
  if (place >= end) return;
  uint row = wordsAt(order, uint(place >> 2))[place & 3];
  uvec4 first = wordsAt(rows, 2u * row);
  vec3 position = uintBitsToFloat(first.xyz);
  float depth = dot(projection[2].xyz, position) + projection[2].w;
  if (!(depth >= nearPlane)) return;
  vec3 inBox = vec3(dot(boxAxes[0], position), dot(boxAxes[1], position), dot(boxAxes[2], position));
  if (any(lessThan(inBox, boxLow)) || any(greaterThan(inBox, boxHigh))) return;
  uvec4 second = wordsAt(rows, 2u * row + 1u);
  if (float(second.z >> 24) > floating || (second.y & wanted) != wanted) return;
  float opacity = values(second.x, opacityEnds).a;
  float cutoff = 2.0 * log(255.0 * opacity * peak);
  if (mode == ELLIPSES) cutoff = opacity < 0.02 ? 0.0 : 2.0;
  if (!(cutoff > 0.0)) return;
  if (isShaped) {
    curve = curveOf(values(first.w, shapeEnds).a);
    cutoff = max(pow(cutoff / (2.0 * curve.y) + curve.z, 1.0 / curve.x) - OFFSET, 0.0);
  }

  vec2 scales = exp(values(second.y, scaleEnds).xy);
  mat3 R = rotationOf(values(second.x, quatEnds).xyz);
  vec3 M[3];
  for (int i = 0; i < 3; i++) {
    vec4 p = projection[i];
    M[i] = vec3(scales.x * dot(p.xyz, R[0]), scales.y * dot(p.xyz, R[1]), dot(p.xyz, position) + p.w);
  }
  vec2 middle = vec2(M[0].z, M[1].z) / depth;
  vec2 side = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1);
  float radius = sqrt(cutoff / 2.0 + SLACK);
  bool isBeside;
  vec2 at = corner(M, cutoff, middle, radius, side, isBeside);
  if (isBeside) return;
  gl_Position = vec4(2.0 * at / size - 1.0, 0.0, 1.0);

  // Relative to the projected mean: p0 = depth (b.y, -a.y, 0), p1 = depth (-b.x, a.x, 0), p2 = depth plane, all over
  // determinant / nearPlane, so that p2 is nearPlane over the depth of the hit.
  vec2 last = M[2].xy, a = M[0].xy - middle.x * last, b = M[1].xy - middle.y * last;
  float determinant = a.x * b.y - a.y * b.x;
  if (determinant != 0.0) {
    axes = vec4(b.y, -a.y, -b.x, a.x) * (nearPlane / determinant);
    plane = vec3(vec2(b.x * last.y - b.y * last.x, last.x * a.y - last.y * a.x) / determinant, 1.0) * (nearPlane / depth);
  }
  mean = vec3(middle, depth);

  vec4 base = values(first.w, harmonicEnds[0]);
  vec3 color = colorOf(base.rgb, second.w, int(second.y >> 26 & 3u), normalize(position - center));
  uvec2 sides = uvec2(second.y >> 16, second.y >> 21) & 31u;
  region = uvec3(second.z & 0xffffffu, sides);
  if (sides.x == 0u) region.yz = uvec2(0);
  own = vec3(0.0);
  if (isTextured && isClamped && region.y == 1u && region.z == 1u) {
    vec4 texel = texelAt(region.x, vec4(1.0, 0.0, 0.0, 0.0));
    own = texel.rgb;
    opacity *= texel.a;
    region.yz = uvec2(0);
  }
  if (mode == TEXTURE) color = vec3(0.5);
  if (mode == RESOLUTION) {
    float level = log2(float(max(sides.x * sides.y, 1u))) / 8.0;
    float light = 0.35 + 0.65 * level;
    bool isSquare = sides.x == sides.y;
    color = sides.x * sides.y <= 1u ? vec3(0.16)
      : isSquare ? mix(vec3(0.75, 0.82, 1.0), vec3(0.05, 0.15, 0.95), level)
      : mix(vec3(1.0, 0.8, 0.75), vec3(0.95, 0.08, 0.05), level);
    own = vec3(0.0);
  }
  if (mode == NORMALS) {
    vec3 normal = R[2];
    own = 0.5 + 0.5 * (dot(normal, center - position) < 0.0 ? -normal : normal);
  }
  if (mode == FULL || mode == TEXTURE || mode == ELLIPSES) color += own;
  shown = vec4(color, opacity);
  curve.y *= 2.0 * HALF_LOG2E;
  curve.z *= curve.y;
}
`;

export const splatFragment = (variant: Variant): string => `${HEADER}${constantsOf(variant)}${TEXELS}${KERNEL}
flat in vec4 axes;
flat in vec3 plane;
flat in vec3 mean;
flat in vec4 shown;
flat in uvec3 region;
flat in vec3 own;
flat in vec3 curve;

uniform float nearPlane, maxAlpha, extent;

out vec4 fragment;

vec4 textureAt(vec2 uv) {
  vec2 sides = vec2(region.yz), unit = (uv / extent + 1.0) * 0.5;
  vec2 place = isCentred ? unit * sides - 0.5 : unit * (sides - 1.0);
  place = clamp(place, vec2(0.0), sides - 1.0);
  ivec2 low = ivec2(place);
  vec2 f = place - vec2(low);
  vec4 weights = vec4(1.0 - f.x, f.x, 1.0 - f.x, f.x) * vec2(1.0 - f.y, f.y).xxyy;
  return texelAt(region.x + uint(low.y) * region.y + uint(low.x), weights);
}

void main() {
  vec2 offset = gl_FragCoord.xy - mean.xy;
  // The nearest depth over the depth of the ray's hit.
  float q = dot(plane.xy, offset) + plane.z;
  vec2 hit = vec2(dot(axes.xy, offset), dot(axes.zw, offset));
  bool isHit = q > 0.0 && q <= 1.0;
  float rhoRay = isHit ? dot(hit, hit) / (q * q) : 1e30, rhoScreen = 2.0 * dot(offset, offset);
  float rho = min(rhoRay, rhoScreen);

  if (mode == ELLIPSES) {
    if (rho > 2.0) discard;
    float edge = smoothstep(1.25, 1.6, rho);
    fragment = vec4(mix(shown.rgb, vec3(0.02), 0.75 * edge), 1.0);
    return;
  }
  float alpha = shown.a * exp2(isShaped ? curve.z - curve.y * exp2(curve.x * log2(rho + OFFSET)) : -HALF_LOG2E * rho);
  vec3 color = shown.rgb;
  if (isTextured && region.y > 0u) {
    vec2 uv = isHit ? hit / q : vec2(0.0);
    vec4 texel = textureAt(uv);
    if (!isClamped && any(greaterThan(abs(uv), vec2(extent)))) texel = vec4(0.0, 0.0, 0.0, 1.0);
    if (mode == FULL || mode == TEXTURE) color += texel.rgb;
    alpha *= texel.a;
  }
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, maxAlpha);
  if (mode == DEPTH) color = vec3(rhoRay <= rhoScreen ? nearPlane / q : mean.z);
  if (mode == NORMALS) color = own;
  fragment = vec4(color * alpha, alpha);
}
`;

export const SCREEN_VERTEX = `${HEADER}
void main() {
  vec2 side = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  gl_Position = vec4(4.0 * side - 1.0, 0.0, 1.0);
}
`;

export const SCREEN_FRAGMENT = `${HEADER}
uniform sampler2D picture;
uniform int height;
uniform vec3 background;
uniform vec2 depths;
uniform int mode;
uniform float divider;
uniform float gain;
out vec4 fragment;

// Colour ramp: near is bright, far is dark.
vec3 ramp(float t) {
  vec3 a = vec3(0.99, 0.90, 0.60), b = vec3(0.86, 0.35, 0.35), c = vec3(0.22, 0.10, 0.42), d = vec3(0.02, 0.02, 0.08);
  return t < 0.33 ? mix(a, b, t / 0.33) : t < 0.66 ? mix(b, c, (t - 0.33) / 0.33) : mix(c, d, (t - 0.66) / 0.34);
}

void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  vec4 found = texelFetch(picture, ivec2(place.x, height - 1 - place.y), 0);
  vec3 color = gain * found.rgb + (1.0 - found.a) * background;
  if (mode == DEPTH) {
    float depth = found.a > 0.02 ? found.r / found.a : depths.y;
    color = ramp(clamp(log(depth / depths.x) / log(depths.y / depths.x), 0.0, 1.0));
  }
  if (mode == TEXTURE) color = found.rgb + (1.0 - found.a) * vec3(0.5);
  if (divider >= 0.0 && abs(gl_FragCoord.x - divider) < 1.0) color = vec3(1.0);
  fragment = vec4(color, 1.0);
}
`;
