// Ellipses become pictures, and back.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>

#include "bindings.h"
#include "rasterizer.h"

namespace vlgs {
namespace {

template <class T>
void bind_rasterize_of(nb::module_ &m, const char *name) {
  nb::class_<Rasterized<T>>(m, name)
      .def(
          "__init__",
          [](Rasterized<T> *self, Array<const T, -1, 2> mean2d, Array<const T, -1, 3> ellipse,
             Array<const T, -1> depth, const std::vector<Array<const T, -1>> &weights,
             const std::vector<bool> &shape_grads, const std::vector<Rows<const T>> &values,
             const std::vector<int> &groups, const std::vector<int> &chain_of, const RasterizeConfig &config,
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
            new (self) Rasterized<T>(grid, int64_t(depth.shape(0)), splats, std::move(chains),
                                     std::move(parts), config, keep, visible.data(), threads);
          },
          strict("mean2d"), strict("ellipse"), strict("depth"), strict("weights"), "shape_grads"_a,
          strict("values"), "groups"_a, "chain_of"_a, "config"_a, strict("images"), strict("alphas"),
          strict("visible"), "keep"_a, "threads"_a)
      .def(
          "backward",
          [](const Rasterized<T> &self, const std::vector<Rows<const T>> &values,
             const std::vector<std::optional<Image<const T>>> &d_images,
             const std::vector<std::optional<Array<const T, -1, -1>>> &d_alphas,
             std::optional<Array<T, -1, 2>> d_mean2d, std::optional<Array<T, -1, 3>> d_ellipse,
             const std::vector<std::optional<Array<T, -1>>> &d_weights,
             const std::vector<std::optional<Rows<T>>> &d_values, int threads) {
            RasterizeGrads<T> d{};
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
      .def(
          "median_rows",
          [](const Rasterized<T> &self, Array<int64_t, -1, -1> rows, int threads) {
            nb::gil_scoped_release unlocked;
            self.median_rows(rows.data(), threads);
          },
          strict("rows"), "threads"_a)
      .def("work", [](const Rasterized<T> &self) {
        const RasterizeWork work = self.work();
        return std::pair(work.entries, work.weighed);
      });
}

}  // namespace

void bind_rasterize(nb::module_ &m) {
  nb::class_<RasterizeConfig>(m, "RasterizeConfig")
      .def(
          "__init__",
          [](RasterizeConfig *self, double alpha_min, double alpha_max, double transmittance_min,
             bool stop_before, int64_t memory_budget, bool tile_test, bool block_masks, bool opacity_extent) {
            new (self) RasterizeConfig{alpha_min,   alpha_max,     transmittance_min,
                                       stop_before, memory_budget, {tile_test, block_masks, opacity_extent}};
          },
          "alpha_min"_a, "alpha_max"_a, "transmittance_min"_a, "stop_before"_a, "memory_budget"_a,
          "tile_test"_a, "block_masks"_a, "opacity_extent"_a);
  bind_rasterize_of<float>(m, "RasterizedFloat");
  bind_rasterize_of<double>(m, "RasterizedDouble");
}

}  // namespace vlgs
