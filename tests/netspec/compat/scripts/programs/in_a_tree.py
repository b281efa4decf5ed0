from caffe import of_a_fork
import caffe.of_a_fork, caffe.old, caffe.test.test_it
assert of_a_fork is caffe.of_a_fork
assert not hasattr(caffe, "nothing") and caffe.io.__name__ == "netspec.compat.pycaffe.io"
print(caffe.old.value, caffe.test.test_it.value)
