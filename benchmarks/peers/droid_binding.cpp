// DROID-SLAM's bundle adjustment for Python, without the rest of its extension, which needs headers of an older torch.
#include <torch/extension.h>

#include <vector>

std::vector<torch::Tensor> ba_cuda(torch::Tensor poses, torch::Tensor disps, torch::Tensor intrinsics,
                                   torch::Tensor disps_sens, torch::Tensor targets, torch::Tensor weights,
                                   torch::Tensor eta, torch::Tensor ii, torch::Tensor jj, const int t0, const int t1,
                                   const int iterations, const float lm, const float ep, const bool motion_only);

PYBIND11_MODULE(TORCH_EXTENSION_NAME, bindings) { bindings.def("ba", &ba_cuda); }
