// The programs of the GPU. A splat is a quad that ends where its alpha falls below what vlgs draws at all.

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D shapes, sequence;
uniform sampler2D answers;             // language weight, relevancy
uniform highp sampler2DArray harmonics;
uniform vec3 right, down, ahead, eye;  // rows of the rotation, and where the camera is
uniform vec4 lens;                     // fx, fy, cx, cy in pixels
uniform vec2 size;
uniform vec4 slopes;                   // x/z and y/z beyond which the projection is not bent further: low x y, high x y
uniform float near, nearSigmas, blur, least;  // nearSigmas: of a splat's own standard deviations
uniform vec2 colors, further;          // what 0 and 1 stand for, of colours and of harmonics
uniform int coefficients;
uniform bool language;
out vec2 place;                        // in standard deviations
flat out vec4 ink;                     // what is blended, and with which weight

vec3 seen(vec3 color, ivec2 at, vec3 way) {
  float x = way.x, y = way.y, z = way.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[15] = float[15](
    -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
    1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2. * zz - xx - yy), -1.09254843 * x * z, 0.54627422 * (xx - yy),
    -0.59004359 * y * (3. * xx - yy), 2.89061144 * x * y * z, -0.45704580 * y * (4. * zz - xx - yy),
    0.37317633 * z * (2. * zz - 3. * xx - 3. * yy), -0.45704580 * x * (4. * zz - xx - yy),
    1.44530572 * z * (xx - yy), -0.59004359 * x * (xx - 3. * yy));
  for (int k = 0; k < coefficients; k++)
    color += basis[k] * mix(further.xxx, further.yyy, texelFetch(harmonics, ivec3(at, k), 0).rgb);
  return max(color, 0.);
}

void main() {
  gl_Position = vec4(0., 0., 2., 1.);  // outside of everything
  int turn = gl_VertexID >> 2, corner = gl_VertexID & 3;
  int splat = int(texelFetch(sequence, ivec2(turn % ${ROW}, turn / ${ROW}), 0).r);
  ivec2 at = ivec2(splat % ${ROW}, splat / ${ROW});
  ivec2 texel = ivec2(at.x * ${TEXELS}, at.y);
  uvec4 first = texelFetch(shapes, texel, 0);
  vec3 way = uintBitsToFloat(first.xyz) - eye;
  vec3 there = vec3(dot(right, way), dot(down, way), dot(ahead, way));
  if (there.z <= near) return;

  vec4 own = vec4(first.w & 255u, first.w >> 8 & 255u, first.w >> 16 & 255u, first.w >> 24) / 255.;
  if (language) {
    vec2 answer = texelFetch(answers, at, 0).rg;
    ink = vec4(answer.g, 0., 0., answer.r);
  } else {
    ink = vec4(seen(mix(colors.xxx, colors.yyy, own.rgb), at, normalize(way)), own.a);
  }
  if (ink.a < least) return;

  vec4 a = uintBitsToFloat(texelFetch(shapes, texel + ivec2(1, 0), 0));
  vec2 b = uintBitsToFloat(texelFetch(shapes, texel + ivec2(2, 0), 0)).xy;
  mat3 covariance = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  if (there.z * there.z <= nearSigmas * nearSigmas * dot(ahead, covariance * ahead)) return;
  vec2 slope = clamp(there.xy / there.z, slopes.xy, slopes.zw);
  vec3 u = lens.x / there.z * (right - slope.x * ahead), v = lens.y / there.z * (down - slope.y * ahead);
  vec3 spread = covariance * u;
  float xx = dot(u, spread) + blur, xy = dot(v, spread), yy = dot(v, covariance * v) + blur;

  // Axes of the ellipse: eigenvectors of the 2D covariance.
  float middle = (xx + yy) / 2., gap = length(vec2((xx - yy) / 2., xy));
  vec2 axis = xx > yy ? vec2(middle + gap - yy, xy) : vec2(xy, middle + gap - xx);
  axis = gap > 1e-6 * middle ? normalize(axis) : vec2(1., 0.);
  vec2 lengths = sqrt(vec2(middle + gap, max(middle - gap, blur)));

  place = (vec2(corner & 1, corner >> 1) * 2. - 1.) * sqrt(2. * log(ink.a / least) + 1e-6);
  vec2 pixel = lens.xy * there.xy / there.z + lens.zw;
  pixel += place.x * lengths.x * axis + place.y * lengths.y * vec2(-axis.y, axis.x);
  gl_Position = vec4(2. * pixel.x / size.x - 1., 1. - 2. * pixel.y / size.y, 0., 1.);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
uniform float least, most;
in vec2 place;
flat in vec4 ink;
out vec4 blended;
void main() {
  float alpha = min(ink.a * exp(-0.5 * dot(place, place)), most);
  if (alpha < least) discard;
  blended = vec4(ink.rgb * alpha, alpha);
}`;

const WHOLE_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0., 1.);
}`;

// Colour alone; or the heat of a word over grey, dimmed where it does not answer; or colour there and dim grey elsewhere.
const WHOLE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D color, language, heat;
uniform float threshold;               // of a word's bytes, from 0 to 1
uniform vec2 ends;                     // what is coldest and hottest, likewise
uniform int shown;                     // 0 colour, 1 heat, 2 cut-out
out vec4 pixel;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 plain = clamp(texelFetch(color, at, 0).rgb, 0., 1.);
  pixel = vec4(plain, 1.);
  if (shown == 0) return;
  vec4 sum = texelFetch(language, at, 0);
  float relevancy = sum.a > 0. ? sum.r / sum.a : 0.;
  bool answers = sum.a > 0. && relevancy > threshold;
  float grey = dot(plain, vec3(0.299, 0.587, 0.114));
  float warmth = clamp((relevancy - ends.x) / (ends.y - ends.x), 0., 1.);
  vec3 hot = texelFetch(heat, ivec2(warmth * 255. + 0.5, 0), 0).rgb;
  if (shown == 1) pixel.rgb = mix(vec3(grey), hot, 0.65) * (answers ? 1. : 0.4);
  else if (!answers) pixel.rgb = vec3(0.3 * grey);
}`;
