// The kernels of one instruction set; see kernels.h for what they do.
#pragma once

#include "kernels.h"

#if !defined(VLGS_ISA_NS) || !defined(VLGS_NUMBER)
#error "compile the kernels with -DVLGS_ISA_NS=<name> -DVLGS_NUMBER=<float or double>"
#endif

namespace vlgs::VLGS_ISA_NS {

using Number = VLGS_NUMBER;
using T = Number;  // as the list in kernels.h has it

#define VLGS_DECLARED(result, name, ...) result name(__VA_ARGS__);
VLGS_KERNELS(VLGS_DECLARED)
#undef VLGS_DECLARED

extern const Kernels<Number> kKernels;

}  // namespace vlgs::VLGS_ISA_NS
