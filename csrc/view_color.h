// Colour of Gaussians seen from a point: fused colour plus spherical harmonics of degrees 1 to 3, no less
// than 0.
#pragma once

#include <array>
#include <cstdint>

namespace vlgs {

template <class T>
struct ViewColor {
  int64_t n, coefficients;      // of degrees 1, 2, ...; those above `degree` are not read
  int degree;                   // 1 to 3
  const T *color, *sh, *means;  // [n, 3], [n, coefficients, 3], [n, 3]
  std::array<double, 3> eye;    // world units
};

template <class T>
void view_color(const ViewColor<T> &, T *out, int threads);
template <class T>
void view_color_backward(const ViewColor<T> &, const T *d_out, T *d_color, T *d_sh, T *d_means, int threads);

}  // namespace vlgs
