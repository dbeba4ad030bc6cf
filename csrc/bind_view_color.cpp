// Spherical harmonics seen from a camera become colours, and back.
#include <nanobind/stl/vector.h>

#include <stdexcept>

#include "bindings.h"
#include "view_color.h"

namespace vlgs {
namespace {

template <class T>
void bind_view_color_of(nb::module_ &m) {
  using Color = Array<const T, -1, 3>;
  using Coefficients = Array<const T, -1, -1, 3>;
  const auto make = [](const Color &color, const Coefficients &sh, const Color &means,
                       const std::vector<double> &eye, int degree) {
    if (eye.size() != 3 || degree < 1 || degree > 3)
      throw std::invalid_argument("view_color: eye must be 3 numbers, and degree 1, 2 or 3");
    return ViewColor<T>{
        int64_t(color.shape(0)), int64_t(sh.shape(1)), degree, color.data(), sh.data(), means.data(),
        {eye[0], eye[1], eye[2]}};
  };
  m.def(
      "view_color",
      [make](Color color, Coefficients sh, Color means, const std::vector<double> &eye, int degree,
             Array<T, -1, 3> out, int threads) {
        const auto v = make(color, sh, means, eye, degree);
        nb::gil_scoped_release unlocked;
        view_color<T>(v, out.data(), threads);
      },
      strict("color"), strict("sh"), strict("means"), "eye"_a, "degree"_a, strict("out"), "threads"_a);
  m.def(
      "view_color_backward",
      [make](Color color, Coefficients sh, Color means, const std::vector<double> &eye, int degree,
             Color d_out, Array<T, -1, 3> d_color, Array<T, -1, -1, 3> d_sh, Array<T, -1, 3> d_means,
             int threads) {
        const auto v = make(color, sh, means, eye, degree);
        nb::gil_scoped_release unlocked;
        view_color_backward<T>(v, d_out.data(), d_color.data(), d_sh.data(), d_means.data(), threads);
      },
      strict("color"), strict("sh"), strict("means"), "eye"_a, "degree"_a, strict("d_out"), strict("d_color"),
      strict("d_sh"), strict("d_means"), "threads"_a);
}

}  // namespace

void bind_view_color(nb::module_ &m) {
  bind_view_color_of<float>(m);
  bind_view_color_of<double>(m);
}

}  // namespace vlgs
