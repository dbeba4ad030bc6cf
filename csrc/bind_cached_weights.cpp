// Pictures whose weights were kept, and back.
#include <stdexcept>
#include <string>

#include "bindings.h"
#include "cached_weights.h"

namespace vlgs {
namespace {

// Unlike a picture, a cached view outlives the tensors that it was made from.
template <class T, class Values, class Picture>
void require_shapes(const CachedWeights<T> &weights, const Values &values, const Picture &image) {
  if (!weights.kept()) throw std::invalid_argument("cached view: weights must be kept before they are used");
  if (int64_t(values.shape(0)) != weights.rows() || int64_t(image.shape(0)) != weights.height() ||
      int64_t(image.shape(1)) != weights.width() || image.shape(2) != values.shape(1))
    throw std::invalid_argument("cached view: values and image must have its rows and pixels, got " +
                                std::to_string(values.shape(0)) + " rows, " + std::to_string(image.shape(0)) +
                                " x " + std::to_string(image.shape(1)) + " pixels");
}

template <class T>
void bind_cached_weights_of(nb::module_ &m, const char *name) {
  nb::class_<CachedWeights<T>>(m, name)
      .def(
          "__init__",
          [](CachedWeights<T> *self, const Rasterized<T> &picture, int threads) {
            nb::gil_scoped_release unlocked;
            new (self) CachedWeights<T>(picture, threads);
          },
          "picture"_a, "threads"_a)
      .def(
          "keep",
          [](CachedWeights<T> &self, const Rasterized<T> &picture, int threads) {
            nb::gil_scoped_release unlocked;
            self.keep(picture, threads);
          },
          "picture"_a, "threads"_a)
      .def_prop_ro("bytes", &CachedWeights<T>::bytes)
      .def(
          "render",
          [](const CachedWeights<T> &self, Rows<const T> values, Image<T> image, int threads) {
            require_shapes(self, values, image);
            nb::gil_scoped_release unlocked;
            self.render(values.data(), int64_t(values.shape(1)), image.data(), threads);
          },
          strict("values"), strict("image"), "threads"_a)
      .def(
          "backward",
          [](const CachedWeights<T> &self, Image<const T> d_image, Rows<T> d_values, int threads) {
            require_shapes(self, d_values, d_image);
            nb::gil_scoped_release unlocked;
            self.backward(d_image.data(), int64_t(d_values.shape(1)), d_values.data(), threads);
          },
          strict("d_image"), strict("d_values"), "threads"_a);
}

}  // namespace

void bind_cached_weights(nb::module_ &m) {
  bind_cached_weights_of<float>(m, "CachedWeightsFloat");
  bind_cached_weights_of<double>(m, "CachedWeightsDouble");
}

}  // namespace vlgs
