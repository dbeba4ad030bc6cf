// What Python sees. Shapes that belong together are checked where the tensors come from (vlgs/ops); here
// arrays become pointers, the interpreter lock is released, and nothing is computed.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <string>

#include "attention.h"
#include "frozen.h"
#include "rasterizer.h"
#include "squared_error.h"
#include "ssim.h"
#include "view_color.h"

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

// Unlike a picture, a frozen view outlives the tensors that it was made from.
template <class T, class Values, class Picture>
void require_shapes(const Frozen<T> &frozen, const Values &values, const Picture &image) {
  if (!frozen.kept()) throw std::invalid_argument("frozen view: weights must be kept before they are used");
  if (int64_t(values.shape(0)) != frozen.rows() || int64_t(image.shape(0)) != frozen.height() ||
      int64_t(image.shape(1)) != frozen.width() || image.shape(2) != values.shape(1))
    throw std::invalid_argument("frozen view: values and image must have its rows and pixels, got " +
                                std::to_string(values.shape(0)) + " rows, " + std::to_string(image.shape(0)) +
                                " x " + std::to_string(image.shape(1)) + " pixels");
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
          strict("d_ellipse").none(), strict("d_weights"), strict("d_values"), "threads"_a)
      .def("work", [](const Blend<T> &self) {
        const BlendWork work = self.work();
        return std::pair(work.entries, work.weighed);
      });
}

AttentionShape attention_shape(int64_t color, int64_t feature, int64_t heads, int64_t width, bool self) {
  return {color, feature, heads, width, self};
}

// The layers in the order of AttentionLayers, each of the size that the shape gives it.
template <class T, class Tensor>
AttentionLayers<T *> layer_pointers(const AttentionShape &shape, const std::vector<Tensor> &tensors) {
  AttentionLayers<int64_t> sizes = layer_sizes(shape);
  AttentionLayers<T *> layers;
  bool fits = int(tensors.size()) == layers.kCount;
  for (int i = 0; fits && i < layers.kCount; ++i) {
    fits = int64_t(tensors[i].size()) == sizes[i];
    layers[i] = tensors[i].data();
  }
  if (!fits) throw std::invalid_argument("attention: layers must have the sizes of the shape");
  return layers;
}

template <class T>
void bind_attention(nb::module_ &m) {
  using Layer = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
  using ConstLayer = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
  m.def(
      "attention",
      [](Rows<const T> color, Rows<const T> feature, const std::vector<ConstLayer> &layers, int64_t heads,
         int64_t width, bool self, std::optional<Rows<T>> out_color, Rows<T> out_feature, int threads) {
        const auto shape =
            attention_shape(int64_t(color.shape(1)), int64_t(feature.shape(1)), heads, width, self);
        const Attention<T> a{shape, layer_pointers<const T>(shape, layers), color.data(), feature.data()};
        nb::gil_scoped_release unlocked;
        attention<T>(a, int64_t(color.shape(0)),
                     {out_color ? out_color->data() : nullptr, out_feature.data()}, threads);
      },
      strict("color"), strict("feature"), strict("layers"), "heads"_a, "width"_a, "self_attention"_a,
      strict("out_color").none(), strict("out_feature"), "threads"_a);
  m.def(
      "attention_backward",
      [](Rows<const T> color, Rows<const T> feature, const std::vector<ConstLayer> &layers, int64_t heads,
         int64_t width, bool self, std::optional<Rows<const T>> d_out_color, Rows<const T> d_out_feature,
         Rows<T> d_color, Rows<T> d_feature, const std::vector<Layer> &d_layers, int threads) {
        const auto shape =
            attention_shape(int64_t(color.shape(1)), int64_t(feature.shape(1)), heads, width, self);
        const Attention<T> a{shape, layer_pointers<const T>(shape, layers), color.data(), feature.data()};
        const auto d = layer_pointers<T>(shape, d_layers);
        nb::gil_scoped_release unlocked;
        attention_backward<T>(a, int64_t(color.shape(0)),
                              {d_out_color ? d_out_color->data() : nullptr, d_out_feature.data()},
                              {d_color.data(), d_feature.data()}, d, threads);
      },
      strict("color"), strict("feature"), strict("layers"), "heads"_a, "width"_a, "self_attention"_a,
      strict("d_out_color").none(), strict("d_out_feature"), strict("d_color"), strict("d_feature"),
      strict("d_layers"), "threads"_a);
}

template <class T>
void bind_view_color(nb::module_ &m) {
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

template <class T>
void bind_ssim(nb::module_ &m) {
  using Valid = std::optional<Array<const bool, -1, -1>>;
  using Taps = Array<const T, kTaps>;
  using Floors = std::pair<double, double>;
  const auto make = [](const Image<const T> &a, const Image<const T> &b, const Valid &valid, const Taps &taps,
                       const Floors &floors) {
    return Ssim<T>{int64_t(a.shape(0)),
                   int64_t(a.shape(1)),
                   int64_t(a.shape(2)),
                   a.data(),
                   b.data(),
                   valid ? valid->data() : nullptr,
                   taps.data(),
                   T(floors.first),
                   T(floors.second)};
  };
  m.def(
      "ssim_map",
      [make](Image<const T> a, Image<const T> b, Taps taps, Floors floors, Image<T> map, int threads) {
        const auto s = make(a, b, {}, taps, floors);
        nb::gil_scoped_release unlocked;
        ssim_map<T>(s, map.data(), threads);
      },
      strict("a"), strict("b"), strict("taps"), "floors"_a, strict("map"), "threads"_a);
  m.def(
      "ssim_sums",
      [make](Image<const T> a, Image<const T> b, Valid valid, Taps taps, Floors floors, int threads) {
        const auto s = make(a, b, valid, taps, floors);
        nb::gil_scoped_release unlocked;
        const SsimSums total = ssim_sums<T>(s, threads);
        return std::tuple(total.distance, total.dissimilarity, total.pixels);
      },
      strict("a"), strict("b"), strict("valid").none(), strict("taps"), "floors"_a, "threads"_a);
  const auto backward = [](const Ssim<T> &s, const SsimGrads<T> &d, int threads) {
    nb::gil_scoped_release unlocked;
    ssim_backward<T>(s, d, threads);
  };
  m.def(
      "ssim_map_backward",
      [make, backward](Image<const T> a, Image<const T> b, Taps taps, Floors floors, Image<const T> d_map,
                       Image<T> d_a, std::optional<Image<T>> d_b, int threads) {
        backward(make(a, b, {}, taps, floors), {d_map.data(), 0, 0, d_a.data(), d_b ? d_b->data() : nullptr},
                 threads);
      },
      strict("a"), strict("b"), strict("taps"), "floors"_a, strict("d_map"), strict("d_a"),
      strict("d_b").none(), "threads"_a);
  m.def(
      "ssim_sums_backward",
      [make, backward](Image<const T> a, Image<const T> b, Valid valid, Taps taps, Floors floors,
                       double d_distance, double d_dissimilarity, Image<T> d_a, std::optional<Image<T>> d_b,
                       int threads) {
        backward(make(a, b, valid, taps, floors),
                 {nullptr, T(-d_dissimilarity), T(d_distance), d_a.data(), d_b ? d_b->data() : nullptr},
                 threads);
      },
      strict("a"), strict("b"), strict("valid").none(), strict("taps"), "floors"_a, "d_distance"_a,
      "d_dissimilarity"_a, strict("d_a"), strict("d_b").none(), "threads"_a);
}

template <class T>
void bind_squared_error(nb::module_ &m) {
  using Valid = std::optional<Array<const bool, -1, -1>>;
  const auto make = [](const Image<const T> &a, const Image<const T> &b, const Valid &valid) {
    return SquaredError<T>{int64_t(a.shape(0) * a.shape(1)), int64_t(a.shape(2)), a.data(), b.data(),
                           valid ? valid->data() : nullptr};
  };
  m.def(
      "squared_error",
      [make](Image<const T> a, Image<const T> b, Valid valid, int threads) {
        const auto e = make(a, b, valid);
        nb::gil_scoped_release unlocked;
        const ErrorSum total = squared_error<T>(e, threads);
        return std::pair(total.sum, total.pixels);
      },
      strict("a"), strict("b"), strict("valid").none(), "threads"_a);
  m.def(
      "squared_error_backward",
      [make](Image<const T> a, Image<const T> b, Valid valid, double scale, Image<T> d_a, int threads) {
        const auto e = make(a, b, valid);
        nb::gil_scoped_release unlocked;
        squared_error_backward<T>(e, T(scale), d_a.data(), threads);
      },
      strict("a"), strict("b"), strict("valid").none(), "scale"_a, strict("d_a"), "threads"_a);
}

template <class T>
void bind_frozen(nb::module_ &m, const char *name) {
  nb::class_<Frozen<T>>(m, name)
      .def(
          "__init__",
          [](Frozen<T> *self, const Blend<T> &picture, int threads) {
            nb::gil_scoped_release unlocked;
            new (self) Frozen<T>(picture, threads);
          },
          "picture"_a, "threads"_a)
      .def(
          "keep",
          [](Frozen<T> &self, const Blend<T> &picture, int threads) {
            nb::gil_scoped_release unlocked;
            self.keep(picture, threads);
          },
          "picture"_a, "threads"_a)
      .def_prop_ro("bytes", &Frozen<T>::bytes)
      .def(
          "render",
          [](const Frozen<T> &self, Rows<const T> values, Image<T> image, int threads) {
            require_shapes(self, values, image);
            nb::gil_scoped_release unlocked;
            self.render(values.data(), int64_t(values.shape(1)), image.data(), threads);
          },
          strict("values"), strict("image"), "threads"_a)
      .def(
          "backward",
          [](const Frozen<T> &self, Image<const T> d_image, Rows<T> d_values, int threads) {
            require_shapes(self, d_values, d_image);
            nb::gil_scoped_release unlocked;
            self.backward(d_image.data(), int64_t(d_values.shape(1)), d_values.data(), threads);
          },
          strict("d_image"), strict("d_values"), "threads"_a);
}

// At least so many 16-lane multiply-adds of floats in this thread, for who takes the time; returns how many.
int64_t multiply_adds(int64_t packs) {
  nb::gil_scoped_release unlocked;
  const int64_t rounds = packs / kYardstick + 1;
  volatile float kept = kernels<float>().multiply_add(rounds, 0.5f, 1.0f);
  (void)kept;
  return rounds * kYardstick;
}

}  // namespace
}  // namespace vlgs

NB_MODULE(_csrc, m) {
  using namespace vlgs;
  // Graphs and caches of Python that outlive this module hold on to its objects; nanobind would call that a
  // leak.
  nb::set_leak_warnings(false);
  isa();  // a wish that cannot be met ends the import; later it would be thrown inside a parallel loop
  m.def("isa", &isa);
  m.def("isas", &isas);
  m.def("multiply_adds", &multiply_adds, "packs"_a);
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
             bool stop_before, int64_t memory_budget, bool tile_test, bool block_masks, bool opacity_extent) {
            new (self) BlendConfig{alpha_min,   alpha_max,     transmittance_min,
                                   stop_before, memory_budget, {tile_test, block_masks, opacity_extent}};
          },
          "alpha_min"_a, "alpha_max"_a, "transmittance_min"_a, "stop_before"_a, "memory_budget"_a,
          "tile_test"_a, "block_masks"_a, "opacity_extent"_a);
  bind_project<float>(m);
  bind_project<double>(m);
  bind_blend<float>(m, "BlendFloat");
  bind_blend<double>(m, "BlendDouble");
  bind_attention<float>(m);
  bind_attention<double>(m);
  bind_view_color<float>(m);
  bind_view_color<double>(m);
  bind_ssim<float>(m);
  bind_ssim<double>(m);
  bind_squared_error<float>(m);
  bind_squared_error<double>(m);
  bind_frozen<float>(m, "FrozenFloat");
  bind_frozen<double>(m, "FrozenDouble");
}
