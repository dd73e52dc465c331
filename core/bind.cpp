// The one extension module: converts once, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

NB_MODULE(_core, m) {
    m.doc() = "Kernels of halfwidth: arrays in, arrays out, the papers' symbols.";
}
