from netspec.exact.blas import kernels
kernels()
import scipy.linalg.cython_blas
print(scipy.linalg.cython_blas.__name__, scipy.linalg._fblas.__name__)
