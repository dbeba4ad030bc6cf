// The table of one instruction set, or of double.
#include "isa.h"

namespace vlgs::VLGS_ISA_NS {

const Kernels<Number> kKernels = {project,
                                  project_backward,
                                  boxes,
                                  cover,
                                  blend_scratch,
                                  backward_scratch,
                                  blend,
                                  blend_backward,
                                  freeze,
                                  frozen_blend,
                                  frozen_upstream,
                                  frozen_backward,
                                  attention_scratch<Number>,
                                  attention,
                                  attention_backward,
                                  multiply_add,
                                  ssim_scratch,
                                  ssim_map_rows,
                                  ssim_sum_rows,
                                  ssim_backward_scratch,
                                  ssim_backward_rows,
                                  squared_error_chunk,
                                  squared_error_chunk_backward};

}  // namespace vlgs::VLGS_ISA_NS
