// Real spherical harmonics with the signs, order and constants of 3DGS, and their slopes along x, y and z.
#include "view_color.h"

#include <algorithm>
#include <cmath>

#include "threads.h"

namespace vlgs {
namespace {

constexpr int kMost = 15;
constexpr int count_of(int degree) { return (degree + 1) * (degree + 1) - 1; }
constexpr double kC1 = 0.48860251190291992;  // sqrt(3 / 4 pi)
constexpr double kC2[3] = {1.0925484305920792, 0.31539156525252005, 0.54627421529603959};
constexpr double kC3[5] = {0.59004358992664352, 2.8906114426405538, 0.45704579946446572, 0.37317633259011546,
                           1.4453057213202769};
// Nearer than this to the eye a Gaussian has no direction worth the name.
constexpr double kMinDistance = 1e-8;

template <class T>
struct Direction {
  T x, y, z, length;
};
template <class T>
Direction<T> direction(const T *mean, const std::array<double, 3> &eye) {
  const T x = mean[0] - T(eye[0]), y = mean[1] - T(eye[1]), z = mean[2] - T(eye[2]);
  const T length = std::sqrt(x * x + y * y + z * z), inverse = 1 / std::max(length, T(kMinDistance));
  return {x * inverse, y * inverse, z * inverse, length};
}

template <int kDegree, class T>
void basis(const Direction<T> &d, T *b) {
  const T x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  b[0] = -T(kC1) * y, b[1] = T(kC1) * z, b[2] = -T(kC1) * x;
  if constexpr (kDegree >= 2) {
    b[3] = T(kC2[0]) * x * y, b[4] = -T(kC2[0]) * y * z, b[5] = T(kC2[1]) * (2 * zz - xx - yy);
    b[6] = -T(kC2[0]) * x * z, b[7] = T(kC2[2]) * (xx - yy);
  }
  if constexpr (kDegree >= 3) {
    b[8] = -T(kC3[0]) * y * (3 * xx - yy), b[9] = T(kC3[1]) * x * y * z;
    b[10] = -T(kC3[2]) * y * (4 * zz - xx - yy), b[11] = T(kC3[3]) * z * (2 * zz - 3 * xx - 3 * yy);
    b[12] = -T(kC3[2]) * x * (4 * zz - xx - yy), b[13] = T(kC3[4]) * z * (xx - yy);
    b[14] = -T(kC3[0]) * x * (xx - 3 * yy);
  }
}

// Gradient of sum_k g[k] basis[k] by the direction.
template <int kDegree, class T>
void basis_backward(const Direction<T> &d, const T *g, T *out) {
  const T x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  T dx = -T(kC1) * g[2], dy = -T(kC1) * g[0], dz = T(kC1) * g[1];
  if constexpr (kDegree >= 2) {
    const T g3 = T(kC2[0]) * g[3], g4 = -T(kC2[0]) * g[4], g5 = 2 * T(kC2[1]) * g[5];
    const T g6 = -T(kC2[0]) * g[6], g7 = 2 * T(kC2[2]) * g[7];
    dx += g3 * y - g5 * x + g6 * z + g7 * x;
    dy += g3 * x + g4 * z - g5 * y - g7 * y;
    dz += g4 * y + 2 * g5 * z + g6 * x;
  }
  if constexpr (kDegree >= 3) {
    const T g8 = -T(kC3[0]) * g[8], g9 = T(kC3[1]) * g[9], g10 = -T(kC3[2]) * g[10];
    const T g11 = T(kC3[3]) * g[11], g12 = -T(kC3[2]) * g[12], g13 = T(kC3[4]) * g[13];
    const T g14 = -T(kC3[0]) * g[14];
    dx += 6 * g8 * x * y + g9 * y * z - 2 * g10 * x * y - 6 * g11 * x * z + g12 * (4 * zz - 3 * xx - yy) +
          2 * g13 * x * z + 3 * g14 * (xx - yy);
    dy += 3 * g8 * (xx - yy) + g9 * x * z + g10 * (4 * zz - xx - 3 * yy) - 6 * g11 * y * z - 2 * g12 * x * y -
          2 * g13 * y * z - 6 * g14 * x * y;
    dz += g9 * x * y + 8 * g10 * y * z + g11 * (6 * zz - 3 * xx - 3 * yy) + 8 * g12 * x * z + g13 * (xx - yy);
  }
  out[0] = dx, out[1] = dy, out[2] = dz;
}

// Before it is clamped.
template <int kDegree, class T>
void colour(const T *color, const T *sh, const T *b, T *out) {
  T sum[3] = {0, 0, 0};
  for (int k = 0; k < count_of(kDegree); ++k)
    for (int c = 0; c < 3; ++c) sum[c] += b[k] * sh[3 * k + c];
  for (int c = 0; c < 3; ++c) out[c] = color[c] + sum[c];
}

template <int kDegree, class T>
void rows(const ViewColor<T> &v, T *out, int threads) {
  for_each(v.n, threads, [&](int64_t i) {
    T b[kMost];
    basis<kDegree>(direction(v.means + 3 * i, v.eye), b);
    colour<kDegree>(v.color + 3 * i, v.sh + 3 * v.coefficients * i, b, out + 3 * i);
    // What is not a number stays, for the rasterizer to refuse.
    for (int c = 0; c < 3; ++c) out[3 * i + c] = out[3 * i + c] < 0 ? T(0) : out[3 * i + c];
  });
}

template <int kDegree, class T>
void rows_backward(const ViewColor<T> &v, const T *d_out, T *d_color, T *d_sh, T *d_means, int threads) {
  for_each(v.n, threads, [&](int64_t i) {
    T b[kMost], d_basis[kMost], value[3], d[3], d_direction[3];
    const Direction<T> to = direction(v.means + 3 * i, v.eye);
    basis<kDegree>(to, b);
    const T *sh = v.sh + 3 * v.coefficients * i;
    colour<kDegree>(v.color + 3 * i, sh, b, value);
    for (int c = 0; c < 3; ++c) d_color[3 * i + c] = d[c] = value[c] < 0 ? T(0) : d_out[3 * i + c];
    T *to_sh = d_sh + 3 * v.coefficients * i;
    for (int k = 0; k < count_of(kDegree); ++k) {
      for (int c = 0; c < 3; ++c) to_sh[3 * k + c] = b[k] * d[c];
      d_basis[k] = sh[3 * k] * d[0] + sh[3 * k + 1] * d[1] + sh[3 * k + 2] * d[2];
    }
    std::fill(to_sh + 3 * count_of(kDegree), to_sh + 3 * v.coefficients, T(0));
    basis_backward<kDegree>(to, d_basis, d_direction);
    const T along = to.length > T(kMinDistance)
                        ? d_direction[0] * to.x + d_direction[1] * to.y + d_direction[2] * to.z
                        : T(0);
    const T inverse = 1 / std::max(to.length, T(kMinDistance));
    d_means[3 * i] = (d_direction[0] - along * to.x) * inverse;
    d_means[3 * i + 1] = (d_direction[1] - along * to.y) * inverse;
    d_means[3 * i + 2] = (d_direction[2] - along * to.z) * inverse;
  });
}

}  // namespace

template <class T>
void view_color(const ViewColor<T> &v, T *out, int threads) {
  threads = worth(v.n, threads);
  if (v.degree == 1) return rows<1>(v, out, threads);
  if (v.degree == 2) return rows<2>(v, out, threads);
  rows<3>(v, out, threads);
}

template <class T>
void view_color_backward(const ViewColor<T> &v, const T *d_out, T *d_color, T *d_sh, T *d_means,
                         int threads) {
  threads = worth(v.n, threads);
  if (v.degree == 1) return rows_backward<1>(v, d_out, d_color, d_sh, d_means, threads);
  if (v.degree == 2) return rows_backward<2>(v, d_out, d_color, d_sh, d_means, threads);
  rows_backward<3>(v, d_out, d_color, d_sh, d_means, threads);
}

template void view_color(const ViewColor<float> &, float *, int);
template void view_color(const ViewColor<double> &, double *, int);
template void view_color_backward(const ViewColor<float> &, const float *, float *, float *, float *, int);
template void view_color_backward(const ViewColor<double> &, const double *, double *, double *, double *,
                                  int);

}  // namespace vlgs
