// Gaussians and a camera become ellipses on the image plane, and back.
#include <nanobind/stl/vector.h>

#include <stdexcept>

#include "bindings.h"
#include "rasterizer.h"

namespace vlgs {
namespace {

Camera make_camera(const std::vector<double> &viewmat, const std::vector<double> &intrinsics,
                   const std::vector<double> &slopes, double near, double near_sigmas, double blur) {
  if (viewmat.size() != 16 || intrinsics.size() != 4 || slopes.size() != 4)
    throw std::invalid_argument("Camera: viewmat, intrinsics, slopes must be 16, 4 and 4 numbers");
  Camera c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.rotation[3 * i + j] = viewmat[4 * i + j];
    c.translation[i] = viewmat[4 * i + 3];
  }
  c.fx = intrinsics[0], c.fy = intrinsics[1], c.cx = intrinsics[2], c.cy = intrinsics[3];
  c.slope_low[0] = slopes[0], c.slope_high[0] = slopes[1];
  c.slope_low[1] = slopes[2], c.slope_high[1] = slopes[3];
  c.near = near, c.near_sigmas = near_sigmas, c.blur = blur;
  return c;
}

template <class T>
void bind_project_of(nb::module_ &m) {
  m.def(
      "project",
      [](const Camera &camera, Array<const T, -1, 3> means, Array<const T, -1, 4> quats,
         Array<const T, -1, 3> scales, Array<T, -1, 2> mean2d, Array<T, -1, 3> ellipse, Array<T, -1> depth,
         int threads) {
        nb::gil_scoped_release unlocked;
        project<T>(camera, int64_t(means.shape(0)), {means.data(), quats.data(), scales.data()},
                   {mean2d.data(), ellipse.data(), depth.data()}, threads);
      },
      "camera"_a, strict("means"), strict("quats"), strict("scales"), strict("mean2d"), strict("ellipse"),
      strict("depth"), "threads"_a);
  m.def(
      "project_backward",
      [](const Camera &camera, Array<const T, -1, 3> means, Array<const T, -1, 4> quats,
         Array<const T, -1, 3> scales, Array<const T, -1> depth, Array<const T, -1, 2> d_mean2d,
         Array<const T, -1, 3> d_ellipse, Array<T, -1, 3> d_means, Array<T, -1, 4> d_quats,
         Array<T, -1, 3> d_scales, int threads) {
        nb::gil_scoped_release unlocked;
        project_backward<T>(camera, int64_t(means.shape(0)), {means.data(), quats.data(), scales.data()},
                            {depth.data(), d_mean2d.data(), d_ellipse.data(), d_means.data(), d_quats.data(),
                             d_scales.data()},
                            threads);
      },
      "camera"_a, strict("means"), strict("quats"), strict("scales"), strict("depth"), strict("d_mean2d"),
      strict("d_ellipse"), strict("d_means"), strict("d_quats"), strict("d_scales"), "threads"_a);
}

}  // namespace

void bind_project(nb::module_ &m) {
  nb::class_<Camera>(m, "Camera")
      .def(
          "__init__",
          [](Camera *self, const std::vector<double> &viewmat, const std::vector<double> &intrinsics,
             const std::vector<double> &slopes, double near, double near_sigmas, double blur) {
            new (self) Camera(make_camera(viewmat, intrinsics, slopes, near, near_sigmas, blur));
          },
          "viewmat"_a, "intrinsics"_a, "slopes"_a, "near"_a, "near_sigmas"_a, "blur"_a);
  bind_project_of<float>(m);
  bind_project_of<double>(m);
}

}  // namespace vlgs
