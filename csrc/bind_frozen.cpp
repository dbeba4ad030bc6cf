// Pictures whose weights were kept, and back.
#include <stdexcept>
#include <string>

#include "bindings.h"
#include "frozen.h"

namespace vlgs {
namespace {

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
void bind_frozen_of(nb::module_ &m, const char *name) {
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

}  // namespace

void bind_frozen(nb::module_ &m) {
  bind_frozen_of<float>(m, "FrozenFloat");
  bind_frozen_of<double>(m, "FrozenDouble");
}

}  // namespace vlgs
