// The shaders: every Gaussian is projected once into a texture, then drawn as a quad, then the blended picture goes onto the canvas.
// They follow shaders/project_forward.wgsl and shaders/rasterize_forward.wgsl.

const SHADER_HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp usampler2D;\nprecision highp sampler2D;\n";

export const SCREEN_VERTEX = SHADER_HEAD + `
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  gl_Position = vec4(corner * 4.0 - 1.0, 0.0, 1.0);
}`;

// One fragment is one slot. Out go mean x, mean y, and the conic's factor, then colour and opacity; opacity 0 marks what is not drawn.
const PROJECT_HEAD = `
uniform usampler2D base;
uniform usampler2D harmonics;
uniform usampler2D seen;
uniform vec4 rows[3];
uniform vec3 center;
uniform vec4 intrinsics;
uniform vec4 bounds;
uniform vec2 size;
uniform int degree;
// 1 where opacities shrink as the dilation spreads a Gaussian, else 0.
uniform float antialiased;
// 0: colour, 1: depth, 2: keyframes that see it.
uniform int shown;
// First value and inverse width of the range of depths or numbers.
uniform vec2 range;
layout(location = 0) out uvec4 shape;
layout(location = 1) out uvec4 paint;

const float ALPHA_MIN = 1.0 / 255.0;
const float SQRT_HALF = 0.70710678;

mat3 rotation_of(uint bits) {
  vec3 three = vec3(uvec3(bits, bits >> 10u, bits >> 20u) & 1023u) / 1023.0 * 2.0 * SQRT_HALF - SQRT_HALF;
  float left = sqrt(max(0.0, 1.0 - dot(three, three)));
  uint largest = bits >> 30u;
  vec4 q = largest == 0u ? vec4(left, three) : largest == 1u ? vec4(three.x, left, three.yz)
    : largest == 2u ? vec4(three.xy, left, three.z) : vec4(three, left);
  q = normalize(q);
  vec3 v = q.xyz;
  float w = q.w;
  return mat3(
    1.0 - 2.0 * (v.y * v.y + v.z * v.z), 2.0 * (v.x * v.y + w * v.z), 2.0 * (v.x * v.z - w * v.y),
    2.0 * (v.x * v.y - w * v.z), 1.0 - 2.0 * (v.x * v.x + v.z * v.z), 2.0 * (v.y * v.z + w * v.x),
    2.0 * (v.x * v.z + w * v.y), 2.0 * (v.y * v.z - w * v.x), 1.0 - 2.0 * (v.x * v.x + v.y * v.y));
}
`;

const PROJECT_HARMONICS = `
uint words[12];

vec3 coefficient(int k) {
  vec3 sum;
  for (int channel = 0; channel < 3; channel++) {
    int i = 3 * (k - 1) + channel;
    sum[channel] = float(int(words[i >> 2] << (24 - 8 * (i & 3))) >> 24);
  }
  return sum / 127.0;
}

void load_words(int texel, ivec2 slot) {
  uvec4 four = texelFetch(harmonics, ivec2(slot.x * degree + texel, slot.y), 0);
  words[4 * texel] = four.x;
  words[4 * texel + 1] = four.y;
  words[4 * texel + 2] = four.z;
  words[4 * texel + 3] = four.w;
}

vec3 harmonics_of(ivec2 slot, vec3 d) {
  vec3 q = d * d;
  load_words(0, slot);
  vec3 sum = -0.48860251 * d.y * coefficient(1) + 0.48860251 * d.z * coefficient(2) - 0.48860251 * d.x * coefficient(3);
  if (degree > 1) {
    load_words(1, slot);
    sum += 1.0925484 * d.x * d.y * coefficient(4) - 1.0925484 * d.y * d.z * coefficient(5)
      + 0.31539157 * (2.0 * q.z - q.x - q.y) * coefficient(6) - 1.0925484 * d.x * d.z * coefficient(7)
      + 0.54627421 * (q.x - q.y) * coefficient(8);
  }
  if (degree > 2) {
    load_words(2, slot);
    sum += -0.59004359 * d.y * (3.0 * q.x - q.y) * coefficient(9) + 2.8906114 * d.x * d.y * d.z * coefficient(10)
      - 0.45704579 * d.y * (4.0 * q.z - q.x - q.y) * coefficient(11)
      + 0.37317633 * d.z * (2.0 * q.z - 3.0 * q.x - 3.0 * q.y) * coefficient(12)
      - 0.45704579 * d.x * (4.0 * q.z - q.x - q.y) * coefficient(13) + 1.4453057 * d.z * (q.x - q.y) * coefficient(14)
      - 0.59004359 * d.x * (q.x - 3.0 * q.y) * coefficient(15);
  }
  return sum;
}
`;

const PROJECT_MAIN = `
vec3 paint_of(ivec2 slot, vec3 mean, float depth, uvec4 second) {
  if (shown == 1) {
    return vec3((depth - range.x) * range.y);
  }
  if (shown == 2) {
    return vec3((float(texelFetch(seen, slot, 0).x) - range.x) * range.y);
  }
  vec2 blue_scale = unpackHalf2x16(second.w);
  vec3 sum = vec3(0.5) + 0.28209479 * vec3(unpackHalf2x16(second.z), blue_scale.x);
  if (degree > 0 && blue_scale.y > 0.0) {
    sum += blue_scale.y * harmonics_of(slot, normalize(mean - center));
  }
  return max(sum, vec3(0.0));
}

void main() {
  ivec2 slot = ivec2(gl_FragCoord.xy);
  shape = uvec4(0u);
  paint = uvec4(0u);
  uvec4 one = texelFetch(base, ivec2(2 * slot.x, slot.y), 0);
  uvec4 two = texelFetch(base, ivec2(2 * slot.x + 1, slot.y), 0);
  vec3 mean = uintBitsToFloat(one.xyz);
  float opacity = float(one.w & 65535u) / 65535.0;
  vec3 p = vec3(dot(rows[0].xyz, mean), dot(rows[1].xyz, mean), dot(rows[2].xyz, mean)) + vec3(rows[0].w, rows[1].w, rows[2].w);
  if (!(p.z > 0.05 && p.z < 1e5 && opacity >= ALPHA_MIN)) {
    return;
  }
  vec3 scale = exp(vec3(float(one.w >> 16u), float(two.x & 65535u), float(two.x >> 16u)) / 65535.0 * 24.0 - 16.0);
  mat3 axes = rotation_of(two.y);
  mat3 turn = transpose(mat3(rows[0].xyz, rows[1].xyz, rows[2].xyz));
  axes = turn * mat3(axes[0] * scale.x, axes[1] * scale.y, axes[2] * scale.z);
  vec2 tangent = clamp(p.xy / p.z, bounds.xz, bounds.yw);
  vec3 row_x = vec3(intrinsics.x / p.z, 0.0, -intrinsics.x * tangent.x / p.z) * axes;
  vec3 row_y = vec3(0.0, intrinsics.y / p.z, -intrinsics.y * tangent.y / p.z) * axes;
  float dilation = mix(0.3, 0.1, antialiased);
  vec3 covariance = vec3(dot(row_x, row_x) + dilation, dot(row_x, row_y), dot(row_y, row_y) + dilation);
  vec3 area = cross(row_x, row_y);
  float determinant = dot(area, area) + dilation * (covariance.x + covariance.z - dilation);
  if (!(determinant >= 1e-6 && determinant < 1e30)) {
    return;
  }
  opacity *= mix(1.0, sqrt(max(dot(area, area) / determinant, 2.5e-5)), antialiased);
  if (!(opacity >= ALPHA_MIN)) {
    return;
  }
  vec2 at = intrinsics.xy * p.xy / p.z + intrinsics.zw;
  vec2 extent = sqrt(2.0 * log(opacity / ALPHA_MIN) * covariance.xz);
  if (any(lessThan(at + extent, vec2(-0.5))) || any(greaterThan(at - extent, size - 0.5))) {
    return;
  }
  float inverse = inversesqrt(2.0 * covariance.z);
  vec2 factor = vec2(covariance.z, -covariance.y) * inversesqrt(determinant) * inverse;
  vec3 color = min(paint_of(slot, mean, p.z, two), vec3(60000.0));
  shape = uvec4(floatBitsToUint(at), floatBitsToUint(factor));
  paint = uvec4(floatBitsToUint(inverse), packHalf2x16(color.rg), (packHalf2x16(vec2(color.b, 0.0)) & 65535u) | (uint(opacity * 65535.0 + 0.5) << 16u), 1u);
}`;

export const PROJECT_FRAGMENT = SHADER_HEAD + PROJECT_HEAD + PROJECT_HARMONICS + PROJECT_MAIN;

// Quads of one instance: adapters take long for instances of one quad only.
export const BATCH_QUADS = 256;

// A parallelogram around the ellipse on which alpha falls to 1/255.
export const SPLAT_VERTEX = SHADER_HEAD + `
uniform usampler2D order;
uniform int count;
uniform usampler2D shapes;
uniform usampler2D paints;
uniform vec2 size;
flat out vec3 factor;
flat out vec4 at_cut_opacity;
flat out vec3 color;

void main() {
  gl_Position = vec4(2.0, 2.0, 0.0, 1.0);
  int number = gl_InstanceID * ${BATCH_QUADS} + (gl_VertexID >> 2);
  uint slot = texelFetch(order, ivec2(number & 1023, number >> 10), 0).x;
  ivec2 place = ivec2(slot & 1023u, slot >> 10u);
  uvec4 shape = texelFetch(shapes, place, 0);
  uvec4 paint = texelFetch(paints, place, 0);
  factor = vec3(uintBitsToFloat(shape.zw), uintBitsToFloat(paint.x));
  color = vec3(unpackHalf2x16(paint.y), unpackHalf2x16(paint.z).x);
  float opacity = float(paint.z >> 16u) / 65535.0;
  vec2 mean = uintBitsToFloat(shape.xy);
  float cut = log(max(opacity * 255.0, 1e-9));
  at_cut_opacity = vec4(mean, cut, opacity);
  if (paint.w == 1u && number < count) {
    vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
    vec2 u = corner * (sqrt(max(cut, 0.0)) * 1.002 + 1e-4);
    float dy = u.y / factor.z;
    float dx = (u.x - factor.y * dy) / factor.x;
    gl_Position = vec4((mean + vec2(dx, dy) + 0.5) / size * 2.0 - 1.0, 0.0, 1.0);
  }
}`;

export const SPLAT_FRAGMENT = SHADER_HEAD + `
flat in vec3 factor;
flat in vec4 at_cut_opacity;
flat in vec3 color;
out vec4 weighted;

void main() {
  vec2 d = gl_FragCoord.xy - 0.5 - at_cut_opacity.xy;
  vec2 u = vec2(factor.x * d.x + factor.y * d.y, factor.z * d.y);
  float distance = dot(u, u);
  if (!(distance <= at_cut_opacity.z)) {
    discard;
  }
  float alpha = min(0.99, at_cut_opacity.w * exp(-distance));
  weighted = vec4(color * alpha, alpha);
}`;

// Lightness grows evenly from the first to the last.
export const RAMP = [[26, 20, 64], [66, 48, 140], [46, 104, 164], [40, 152, 148], [112, 194, 106], [216, 222, 92], [255, 246, 190]];

const RAMP_TEXT = RAMP.map(c => `vec3(${c.map(v => (v / 255).toFixed(5)).join(", ")})`).join(", ");

// Alpha of the blended picture is what light still passes. `flipped` puts its first row on top of the canvas.
export const RESOLVE_FRAGMENT = SHADER_HEAD + `
uniform sampler2D blended;
uniform vec2 size;
uniform vec3 background;
uniform bool flipped;
uniform bool ramped;
out vec4 shown;

const vec3 RAMP[${RAMP.length}] = vec3[${RAMP.length}](${RAMP_TEXT});

void main() {
  vec2 at = gl_FragCoord.xy / size;
  vec4 sum = texture(blended, flipped ? vec2(at.x, 1.0 - at.y) : at);
  if (ramped) {
    float share = clamp(sum.x / max(1.0 - sum.w, 1e-4), 0.0, 1.0) * ${(RAMP.length - 1).toFixed(1)};
    int first = min(int(share), ${RAMP.length - 2});
    sum.rgb = mix(RAMP[first], RAMP[first + 1], share - float(first)) * (1.0 - sum.w);
  }
  shown = vec4(sum.rgb + sum.w * background, 1.0);
}`;

// A segment is a quad of its width in pixels; what lies behind the near plane is cut off.
export const LINE_VERTEX = SHADER_HEAD + `
layout(location = 0) in vec3 from;
layout(location = 1) in vec3 to;
layout(location = 2) in vec4 tint;
uniform vec4 rows[3];
uniform vec4 intrinsics;
uniform vec2 size;
uniform float width;
// Depth up to which lines fade, so that a frustum around the camera is no grid before its eyes.
uniform float fade;
out vec4 stroke;
out float across;

vec3 in_camera(vec3 v) {
  return vec3(dot(rows[0].xyz, v), dot(rows[1].xyz, v), dot(rows[2].xyz, v)) + vec3(rows[0].w, rows[1].w, rows[2].w);
}

void main() {
  vec3 a = in_camera(from);
  vec3 b = in_camera(to);
  stroke = tint;
  across = 0.0;
  gl_Position = vec4(2.0, 2.0, 0.0, 1.0);
  const float NEAR = 0.01;
  if (a.z < NEAR && b.z < NEAR) {
    return;
  }
  if (a.z < NEAR) {
    a = mix(b, a, (b.z - NEAR) / (b.z - a.z));
  } else if (b.z < NEAR) {
    b = mix(a, b, (a.z - NEAR) / (a.z - b.z));
  }
  vec2 pa = intrinsics.xy * a.xy / a.z + intrinsics.zw;
  vec2 pb = intrinsics.xy * b.xy / b.z + intrinsics.zw;
  vec2 along = pb - pa;
  along = dot(along, along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  float side = float(gl_VertexID & 1) * 2.0 - 1.0;
  float end = float(gl_VertexID >> 1);
  stroke.a *= smoothstep(0.6, 1.6, mix(a.z, b.z, end) / fade);
  float half_width = 0.5 * width + 1.0;
  vec2 at = mix(pa, pb, end) + vec2(-along.y, along.x) * side * half_width + along * (end - 0.5) * width * 0.5;
  across = side * half_width;
  vec2 ndc = (at + 0.5) / size * 2.0 - 1.0;
  gl_Position = vec4(ndc.x, -ndc.y, 0.0, 1.0);
}`;

export const LINE_FRAGMENT = SHADER_HEAD + `
in vec4 stroke;
in float across;
uniform float width;
out vec4 shown;

void main() {
  float cover = clamp(0.5 * width + 0.5 - abs(across), 0.0, 1.0);
  shown = vec4(stroke.rgb, stroke.a * cover);
}`;
