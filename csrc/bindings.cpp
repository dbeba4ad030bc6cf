// What Python sees. Shapes that belong together are checked where the tensors come from (vlgs/render); here
// arrays become pointers, the interpreter lock is released, and nothing is computed.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>

#include "rasterizer.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace vlgs {
namespace {

// nanobind would copy an array of another dtype or stride, and what is written into a copy is lost: hence
// noconvert.
template <class T, nb::ssize_t... Shape>
using Array = nb::ndarray<T, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <class T>
using Rows = Array<T, -1, -1>;
template <class T>
using Image = Array<T, -1, -1, -1>;

nb::arg strict(const char *name) {
  nb::arg arg(name);
  arg.noconvert();
  return arg;
}

Camera make_camera(const std::vector<double> &viewmat, const std::vector<double> &intrinsics,
                   const std::vector<double> &slopes, double near, double blur) {
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
  c.near = near, c.blur = blur;
  return c;
}

template <class T>
void bind_project(nb::module_ &m) {
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

template <class T>
void bind_blend(nb::module_ &m, const char *name) {
  nb::class_<Blend<T>>(m, name)
      .def(
          "__init__",
          [](Blend<T> *self, Array<const T, -1, 2> mean2d, Array<const T, -1, 3> ellipse,
             Array<const T, -1> depth, const std::vector<Array<const T, -1>> &weights,
             const std::vector<bool> &shape_grads, const std::vector<Rows<const T>> &values,
             const std::vector<int> &groups, const std::vector<int> &chain_of, const BlendConfig &config,
             const std::vector<Image<T>> &images, const std::vector<Array<T, -1, -1>> &alphas,
             Array<bool, -1> visible, bool keep, int threads) {
            std::vector<Chain<T>> chains;
            for (size_t c = 0; c < weights.size(); ++c) {
              const auto first = std::find(chain_of.begin(), chain_of.end(), int(c));
              chains.push_back(
                  {weights[c].data(), shape_grads[c], alphas[c].data(), groups[first - chain_of.begin()]});
            }
            std::vector<Part<T>> parts;
            for (size_t k = 0; k < values.size(); ++k) {
              Part<T> part{};
              part.values = values[k].data(), part.image = images[k].data();
              part.channels = int64_t(values[k].shape(1)), part.chain = chain_of[k], part.group = groups[k];
              parts.push_back(part);
            }
            const int64_t height = int64_t(alphas[0].shape(0)), width = int64_t(alphas[0].shape(1));
            const Grid grid{width, height, (width + kTile - 1) / kTile, (height + kTile - 1) / kTile};
            // The splats are only read.
            const Splats<T> splats{const_cast<T *>(mean2d.data()), const_cast<T *>(ellipse.data()),
                                   const_cast<T *>(depth.data())};
            nb::gil_scoped_release unlocked;
            new (self) Blend<T>(grid, int64_t(depth.shape(0)), splats, std::move(chains), std::move(parts),
                                config, keep, visible.data(), threads);
          },
          strict("mean2d"), strict("ellipse"), strict("depth"), strict("weights"), "shape_grads"_a,
          strict("values"), "groups"_a, "chain_of"_a, "config"_a, strict("images"), strict("alphas"),
          strict("visible"), "keep"_a, "threads"_a)
      .def(
          "backward",
          [](const Blend<T> &self, const std::vector<Rows<const T>> &values,
             const std::vector<std::optional<Image<const T>>> &d_images,
             const std::vector<std::optional<Array<const T, -1, -1>>> &d_alphas,
             std::optional<Array<T, -1, 2>> d_mean2d, std::optional<Array<T, -1, 3>> d_ellipse,
             const std::vector<std::optional<Array<T, -1>>> &d_weights,
             const std::vector<std::optional<Rows<T>>> &d_values, int threads) {
            BlendGrads<T> d{};
            for (const auto &a : values) d.values.push_back(a.data());
            for (const auto &a : d_images) d.d_images.push_back(a ? a->data() : nullptr);
            for (const auto &a : d_alphas) d.d_alphas.push_back(a ? a->data() : nullptr);
            d.d_mean2d = d_mean2d ? d_mean2d->data() : nullptr;
            d.d_ellipse = d_ellipse ? d_ellipse->data() : nullptr;
            for (const auto &a : d_weights) d.d_weights.push_back(a ? a->data() : nullptr);
            for (const auto &a : d_values) d.d_values.push_back(a ? a->data() : nullptr);
            nb::gil_scoped_release unlocked;
            self.backward(d, threads);
          },
          strict("values"), strict("d_images"), strict("d_alphas"), strict("d_mean2d").none(),
          strict("d_ellipse").none(), strict("d_weights"), strict("d_values"), "threads"_a);
}

}  // namespace
}  // namespace vlgs

NB_MODULE(_csrc, m) {
  using namespace vlgs;
  // Graphs and caches of Python that outlive this module hold on to its objects; nanobind would call that a
  // leak.
  nb::set_leak_warnings(false);
  m.def("isa", &isa);
  nb::class_<Camera>(m, "Camera")
      .def(
          "__init__",
          [](Camera *self, const std::vector<double> &viewmat, const std::vector<double> &intrinsics,
             const std::vector<double> &slopes, double near,
             double blur) { new (self) Camera(make_camera(viewmat, intrinsics, slopes, near, blur)); },
          "viewmat"_a, "intrinsics"_a, "slopes"_a, "near"_a, "blur"_a);
  nb::class_<BlendConfig>(m, "BlendConfig")
      .def(
          "__init__",
          [](BlendConfig *self, double alpha_min, double alpha_max, double transmittance_min,
             bool stop_before, int64_t memory_budget) {
            new (self) BlendConfig{alpha_min, alpha_max, transmittance_min, stop_before, memory_budget};
          },
          "alpha_min"_a, "alpha_max"_a, "transmittance_min"_a, "stop_before"_a, "memory_budget"_a);
  bind_project<float>(m);
  bind_project<double>(m);
  bind_blend<float>(m, "BlendFloat");
  bind_blend<double>(m, "BlendDouble");
}
