// Gaussians and a camera to ellipses on the image plane, and back (Zwicker et al. 2001). Always
// computed in double, because in float the short axis of a long thin Gaussian is lost, and n Gaussians are
// little work. Both directions are derived in csrc/README.md.
#include "isa.h"
#include "simd.h"

namespace vlgs::VLGS_ISA_NS {
namespace {

// One register of Gaussians is projected at a time.
using Real = NativeOf<double>::Type;
using Flag = NativeOf<double>::Int;
constexpr int kChunk = kNativeBytes / sizeof(double);
// 1 / sigma below this draws the same picture; it keeps sigma within the range of a float.
constexpr double kMinInverse = 1e-18;

struct Vec3 {
  Real x, y, z;
};
inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(Real s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec3 times(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline Real dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Real all(double x) { return x - Real{}; }
inline Vec3 camera_row(const Camera &c, int i) {
  return {all(c.rotation[3 * i]), all(c.rotation[3 * i + 1]), all(c.rotation[3 * i + 2])};
}
inline Real clamp(Real x, double low, double high) {
  x = x < low ? all(low) : x;
  return x > high ? all(high) : x;
}
inline Real root(Real x) {
  for (int l = 0; l < kChunk; ++l) x[l] = __builtin_sqrt(x[l]);
  return x;
}

// Columns of the rotation of a quaternion that need not be normalised.
struct Axes {
  Vec3 x, y, z;
};
inline Vec3 in_axes(const Axes &a, Vec3 v) { return {dot(v, a.x), dot(v, a.y), dot(v, a.z)}; }
inline Axes rotation(Real w, Real x, Real y, Real z, Real scale) {  // scale = 2 / |q|^2
  return {{1 - scale * (y * y + z * z), scale * (x * y + w * z), scale * (x * z - w * y)},
          {scale * (x * y - w * z), 1 - scale * (x * x + z * z), scale * (y * z + w * x)},
          {scale * (x * z + w * y), scale * (y * z - w * x), 1 - scale * (x * x + y * y)}};
}

struct Input {
  Vec3 mean, scale;
  Real qw, qx, qy, qz;
};

// Gaussians on their way to the image; what both directions need.
struct Projection {
  Vec3 in_camera;
  Flag in_front;
  Real inv_z, slope_x, slope_y;  // x/z and y/z
  Real norm2;                    // of the quaternion
  Axes axes;
  Vec3 ray1, ray2;     // rows of the Jacobian times the camera's rotation, without their gain
  Vec3 seen1, seen2;   // the rays in the Gaussian's axes
  Real gain1, gain2;   // focal / z
  Vec3 v1, v2;         // gain * seen * scale: the covariance is their Gram matrix plus blur
  Real yy, slope, xx;  // variance of y; slope of x over y; variance of x given y
};

inline Projection project_rows(const Camera &c, const Input &g) {
  Projection p;
  const Vec3 w0 = camera_row(c, 0), w1 = camera_row(c, 1), w2 = camera_row(c, 2);
  p.in_camera = {dot(w0, g.mean) + c.translation[0], dot(w1, g.mean) + c.translation[1],
                 dot(w2, g.mean) + c.translation[2]};
  p.norm2 = g.qw * g.qw + g.qx * g.qx + g.qy * g.qy + g.qz * g.qz;
  p.in_front = (p.in_camera.z > c.near) & (p.norm2 > 0);
  p.inv_z = 1 / (p.in_front ? p.in_camera.z : all(1));
  p.slope_x = p.in_camera.x * p.inv_z;
  p.slope_y = p.in_camera.y * p.inv_z;
  p.norm2 = p.in_front ? p.norm2 : all(1);
  p.axes = rotation(g.qw, g.qx, g.qy, g.qz, 2 / p.norm2);
  if (c.near_sigmas > 0) {
    const Vec3 deep = all(c.near_sigmas) * times(in_axes(p.axes, w2), g.scale);
    p.in_front = p.in_front & (p.in_camera.z * p.in_camera.z > dot(deep, deep));
  }
  p.ray1 = w0 - clamp(p.slope_x, c.slope_low[0], c.slope_high[0]) * w2;
  p.ray2 = w1 - clamp(p.slope_y, c.slope_low[1], c.slope_high[1]) * w2;
  p.seen1 = in_axes(p.axes, p.ray1);
  p.seen2 = in_axes(p.axes, p.ray2);
  p.gain1 = c.fx * p.inv_z;
  p.gain2 = c.fy * p.inv_z;
  p.v1 = times(p.gain1 * p.seen1, g.scale);
  p.v2 = times(p.gain2 * p.seen2, g.scale);
  const Vec3 area = cross(p.v1, p.v2);
  p.yy = dot(p.v2, p.v2) + c.blur;
  p.slope = dot(p.v1, p.v2) / p.yy;
  // Lagrange's identity turns the determinant into a sum of positive terms.
  p.xx = (dot(area, area) + c.blur * (dot(p.v1, p.v1) + p.yy)) / p.yy;
  return p;
}

struct Upstream {
  Real mean_x, mean_y, inv_sigma_x, slope, inv_sigma_y;
};

// Gradient of (mean2d, ellipse), through every step of project_rows in reverse.
inline Input project_rows_backward(const Camera &c, const Input &g, const Upstream &d) {
  const Projection p = project_rows(c, g);
  const Real inv_xx = 1 / p.xx, inv_yy = 1 / p.yy;

  // With the part of v1 that the slope does not explain, nothing below cancels.
  const Vec3 rest = p.v1 - p.slope * p.v2;
  const Real mixed = d.slope * inv_yy;
  const Vec3 d_v1 = mixed * p.v2 - (d.inv_sigma_x * root(inv_xx) * inv_xx) * rest;
  const Vec3 d_v2 = mixed * rest - (d.inv_sigma_y * root(inv_yy) * inv_yy) * p.v2 - p.slope * d_v1;

  Input out;
  out.scale = times(p.gain1 * p.seen1, d_v1) + times(p.gain2 * p.seen2, d_v2);
  const Vec3 e1 = times(d_v1, g.scale), e2 = times(d_v2, g.scale);  // gradients of gain * seen
  const Real d_gain1 = dot(e1, p.seen1), d_gain2 = dot(e2, p.seen2);
  const Vec3 d_ray1 = p.gain1 * (e1.x * p.axes.x + e1.y * p.axes.y + e1.z * p.axes.z);
  const Vec3 d_ray2 = p.gain2 * (e2.x * p.axes.x + e2.y * p.axes.y + e2.z * p.axes.z);

  // Columns of the gradient of the rotation, then of the quaternion, whose length has no effect.
  const Vec3 r1 = p.gain1 * p.ray1, r2 = p.gain2 * p.ray2;
  const Vec3 dx = e1.x * r1 + e2.x * r2, dy = e1.y * r1 + e2.y * r2, dz = e1.z * r1 + e2.z * r2;
  const Real w = g.qw, x = g.qx, y = g.qy, z = g.qz, two = 2 / p.norm2;
  const Real d_w = two * (z * (dx.y - dy.x) + y * (dz.x - dx.z) + x * (dy.z - dz.y));
  const Real d_x = two * (y * (dy.x + dx.y) + z * (dz.x + dx.z) + w * (dy.z - dz.y) - 2 * x * (dy.y + dz.z));
  const Real d_y = two * (x * (dy.x + dx.y) + z * (dz.y + dy.z) + w * (dz.x - dx.z) - 2 * y * (dx.x + dz.z));
  const Real d_z = two * (x * (dz.x + dx.z) + y * (dz.y + dy.z) + w * (dx.y - dy.x) - 2 * z * (dx.x + dy.y));
  const Real along = (w * d_w + x * d_x + y * d_y + z * d_z) / p.norm2;
  out.qw = d_w - along * w;
  out.qx = d_x - along * x;
  out.qy = d_y - along * y;
  out.qz = d_z - along * z;

  const Vec3 w0 = camera_row(c, 0), w1 = camera_row(c, 1), w2 = camera_row(c, 2);
  const Flag free_x = (p.slope_x >= c.slope_low[0]) & (p.slope_x <= c.slope_high[0]);
  const Flag free_y = (p.slope_y >= c.slope_low[1]) & (p.slope_y <= c.slope_high[1]);
  const Real d_slope_x = c.fx * d.mean_x - (free_x ? dot(d_ray1, w2) : Real{});
  const Real d_slope_y = c.fy * d.mean_y - (free_y ? dot(d_ray2, w2) : Real{});
  const Real d_depth =
      -p.inv_z * (p.slope_x * d_slope_x + p.slope_y * d_slope_y + p.gain1 * d_gain1 + p.gain2 * d_gain2);
  out.mean = (d_slope_x * p.inv_z) * w0 + (d_slope_y * p.inv_z) * w1 + d_depth * w2;
  return out;
}

inline bool finite(double x) { return x - x == 0; }

// Rows from first on, one per lane; lanes beyond the end repeat the last row.
template <class T>
inline Input read_rows(const Gaussians<T> &g, int64_t first, int64_t end) {
  Input in;
  for (int l = 0; l < kChunk; ++l) {
    const int64_t i = first + l < end ? first + l : end - 1;
    const T *m = g.means + 3 * i, *s = g.scales + 3 * i, *q = g.quats + 4 * i;
    in.mean.x[l] = m[0], in.mean.y[l] = m[1], in.mean.z[l] = m[2];
    in.scale.x[l] = s[0], in.scale.y[l] = s[1], in.scale.z[l] = s[2];
    in.qw[l] = q[0], in.qx[l] = q[1], in.qy[l] = q[2], in.qz[l] = q[3];
  }
  return in;
}

}  // namespace

void project(const Camera &c, Gaussians<T> g, Splats<T> out, int64_t begin, int64_t end) {
  for (int64_t first = begin; first < end; first += kChunk) {
    const Projection p = project_rows(c, read_rows(g, first, end));
    const Real mean_x = c.fx * p.slope_x + c.cx, mean_y = c.fy * p.slope_y + c.cy;
    Real inv_sigma_x = root(1 / p.xx), inv_sigma_y = root(1 / p.yy);
    inv_sigma_x = inv_sigma_x < kMinInverse ? all(kMinInverse) : inv_sigma_x;
    inv_sigma_y = inv_sigma_y < kMinInverse ? all(kMinInverse) : inv_sigma_y;
    const Real depth = p.in_front ? p.in_camera.z : Real{};
    for (int64_t i = first; i < end && i < first + kChunk; ++i) {
      const int l = int(i - first);
      T *m = out.mean2d + 2 * i, *e = out.ellipse + 3 * i;
      m[0] = T(mean_x[l]), m[1] = T(mean_y[l]);
      e[0] = T(inv_sigma_x[l]), e[1] = T(p.slope[l]), e[2] = T(inv_sigma_y[l]);
      out.depth[i] = T(depth[l]);
      // What does not fit T lies outside every image.
      const bool fits = finite(m[0]) && finite(m[1]) && finite(e[0]) && finite(e[1]) && finite(e[2]) &&
                        finite(out.depth[i]);
      if (!(fits && depth[l] > 0)) m[0] = m[1] = e[1] = out.depth[i] = 0, e[0] = e[2] = 1;
    }
  }
}

void project_backward(const Camera &c, Gaussians<T> g, GaussianGrads<T> d, int64_t begin, int64_t end) {
  for (int64_t first = begin; first < end; first += kChunk) {
    Upstream up;
    for (int l = 0; l < kChunk; ++l) {
      const int64_t i = first + l < end ? first + l : end - 1;
      up.mean_x[l] = d.d_mean2d[2 * i], up.mean_y[l] = d.d_mean2d[2 * i + 1];
      up.inv_sigma_x[l] = d.d_ellipse[3 * i], up.slope[l] = d.d_ellipse[3 * i + 1];
      up.inv_sigma_y[l] = d.d_ellipse[3 * i + 2];
    }
    const Input out = project_rows_backward(c, read_rows(g, first, end), up);
    for (int64_t i = first; i < end && i < first + kChunk; ++i) {
      const int l = int(i - first);
      T *m = d.d_means + 3 * i, *q = d.d_quats + 4 * i, *s = d.d_scales + 3 * i;
      const bool kept = d.depth[i] > 0;
      m[0] = T(kept ? out.mean.x[l] : 0), m[1] = T(kept ? out.mean.y[l] : 0),
      m[2] = T(kept ? out.mean.z[l] : 0);
      q[0] = T(kept ? out.qw[l] : 0), q[1] = T(kept ? out.qx[l] : 0);
      q[2] = T(kept ? out.qy[l] : 0), q[3] = T(kept ? out.qz[l] : 0);
      s[0] = T(kept ? out.scale.x[l] : 0), s[1] = T(kept ? out.scale.y[l] : 0),
      s[2] = T(kept ? out.scale.z[l] : 0);
    }
  }
}

}  // namespace vlgs::VLGS_ISA_NS
