import netspec
netspec.load_ipython_extension(None)
import caffe
from caffe import layers
assert caffe.__name__ == "netspec.compat.pycaffe"
import sys
del sys.modules["caffe"]
netspec.unload_ipython_extension(None)
try:
    import caffe
except ImportError:
    print("gone")
