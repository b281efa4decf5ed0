"""Caffe's arithmetic, equal in every bit; switched by one option.

The last bits of float32 sums depend on the order of addition. They decide between two nearly equal pixels in a max
pooling, and from then on two trainings differ. So a run of Caffe can be repeated only by computing like Caffe: products
and sums in the order of its BLAS and of its loops, functions rounded like those of the C library.

The build option ``exact`` sets what is computed in this way, on the CPU:

``none``   nothing: torch's kernels.
``small``  (the default) what costs almost no time: Convolution and InnerProduct of up to 500,000 multiply-adds an
           image, BatchNorm, Scale and SoftmaxWithLoss of up to 2,000 values an image, ContrastiveLoss.
``all``    every sum of Caffe's layers, of any size. It is slower. The bits are those of a Caffe with one BLAS thread.

The bits are those of a Caffe with an OpenBLAS that chose the same kernels for its CPU. The files in tests/golden come
from OpenBLAS 0.3.21 with its kernels for AVX-512, in one thread, and glibc 2.36. On CPUs with AVX-512 these kernels are
chosen here too, unless the environment has ``OPENBLAS_CORETYPE`` or SciPy's BLAS was loaded before. These are known to
give other bits than the files:

- Newer OpenBLAS. 0.3.23 to 0.3.30 (SciPy 1.17 has 0.3.30) compute the same bits, in all products of random sizes that
  were compared, transposed or not, and in gemv, dot, asum, axpy and scal. 0.3.31 sums rows of 6 or 7 numbers in another
  order in gemv (over maps of so many pixels: gradients of biases, BatchNorm), 0.3.34 the absolute values of 264 numbers
  and more (asum: HingeLoss, Reduction with ASUM).
- A C library other than glibc, which may round expf, logf, powf and tanh differently. glibc 2.36, 2.41 and 2.43 round
  them in the same way. tanhf, which 2.41 changed, is computed here (netspec.exact.libm).
- Parameters shared with share_mode PERMISSIVE in another shape than their owner's: autograd adds their gradients.
- BatchReindex that chooses an item more than 16 times: Caffe sorts with std::sort, which leaves the order open.
- Scale over a batch of one, or from axis 0 on: Caffe overwrites the gradient of its factors in each pass, where it adds
  up every other parameter's over iter_size and over layers that share it; here they add up too.
- Layers of dialects (SSD, R-CNN and other forks) and Python layers.

Caffe: src/caffe/util/math_functions.cpp, include/caffe/util/mkl_alternate.hpp
"""

NONE, SMALL, ALL = "none", "small", "all"
CHOICES = (NONE, SMALL, ALL)

# The limits of "small": in larger layers, torch's own kernels are faster.
SMALL_PRODUCT = 500_000  # multiply-adds an image, of a convolution or an inner product
SMALL_ITEM = 2_000  # values an image, of layers that pass over memory several times: BatchNorm, Scale, SoftmaxWithLoss
