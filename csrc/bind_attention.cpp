// Fusion of colour and language in a Gaussian, and back.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>

#include "attention.h"
#include "bindings.h"

namespace vlgs {
namespace {

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
void bind_attention_of(nb::module_ &m) {
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

}  // namespace

void bind_attention(nb::module_ &m) {
  bind_attention_of<float>(m);
  bind_attention_of<double>(m);
}

}  // namespace vlgs
