from caffe import of_a_fork
import caffe.of_a_fork, caffe.old, caffe.proto.more, caffe.test.test_it
assert of_a_fork is caffe.of_a_fork and of_a_fork.value == 3
assert (caffe.old.value, caffe.proto.more.value, caffe.test.test_it.value) == (3, 4, 5)
assert not hasattr(caffe, "nothing") and caffe.io.__name__ == "netspec.compat.pycaffe.io"
