"""Caffe's arithmetic, equal in every bit; switched by one option.

The last bits of float32 sums depend on the order of addition. If two pixels of a max pooling are nearly equal, these
bits decide which one wins, and from then on two trainings differ. To repeat a training of Caffe, netspec must add in
the order of Caffe's BLAS and loops, and round functions like the C library.

The build option ``exact`` determines what is computed in this way, on the CPU:

``none``   nothing: torch's kernels.
``small``  (the default) what costs almost no time: Convolution and InnerProduct of up to 500,000 multiply-adds an
           image, BatchNorm, Scale and SoftmaxWithLoss of up to 2,000 values an image, ContrastiveLoss.
``all``    every sum of Caffe's layers, of any size. It is slower. The bits are those of a Caffe with one BLAS thread.

The bits are those of a Caffe whose OpenBLAS uses the same kernels for the CPU. The files in tests/golden were computed
with OpenBLAS 0.3.21 and its kernels for AVX-512, in one thread, and glibc 2.36. On CPUs with AVX-512, netspec uses the
same kernels, unless the environment variable ``OPENBLAS_CORETYPE`` is set or SciPy's BLAS was loaded before. Known
differences from these files:

- Newer OpenBLAS. 0.3.23 to 0.3.30 (SciPy 1.17 has 0.3.30) compute the same bits, in all products of random sizes that
  were compared, transposed or not, and in gemv, dot, asum, axpy and scal. 0.3.31 adds rows of 6 or 7 numbers in another
  order in gemv (gradients of biases and BatchNorm, for maps of 6 or 7 pixels). 0.3.34 adds 264 or more absolute values
  in another order (asum: HingeLoss, Reduction with ASUM).
- A C library other than glibc, which may round expf, logf, powf and tanh differently. glibc 2.36, 2.41 and 2.43 round
  them in the same way. tanhf, which 2.41 changed, is computed here (netspec.exact.libm).
- Parameters shared with share_mode PERMISSIVE in another shape than their owner's: autograd adds their gradients.
- BatchReindex that chooses an item more than 16 times: Caffe sorts with std::sort, which leaves the order open.
- Scale over a batch of one, or from axis 0 on: Caffe overwrites the gradient of its factors in each pass, while it adds
  up all other gradients over iter_size and over the layers that share a parameter. netspec adds up these too.
- Layers of dialects (SSD, R-CNN and other forks) and Python layers.

Caffe: src/caffe/util/math_functions.cpp, include/caffe/util/mkl_alternate.hpp
"""

NONE, SMALL, ALL = "none", "small", "all"
CHOICES = (NONE, SMALL, ALL)

# The limits of "small": in larger layers, torch's own kernels are faster.
SMALL_PRODUCT = 500_000  # multiply-adds an image, of a convolution or an inner product
SMALL_ITEM = 2_000  # values an image, of layers that pass over memory several times: BatchNorm, Scale, SoftmaxWithLoss
