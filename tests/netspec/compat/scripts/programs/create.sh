#!/usr/bin/env sh
# Make a database, its mean and a net, as Caffe's own shell scripts do.
set -e

EXAMPLE=examples/mnist
DATA=data/mnist
BUILD=build/examples/mnist
TOOLS=./build/tools
BACKEND="lmdb"

rm -rf $EXAMPLE/mnist_train_${BACKEND}
$BUILD/convert_mnist_data.bin $DATA/train-images-idx3-ubyte \
  $DATA/train-labels-idx1-ubyte $EXAMPLE/mnist_train_${BACKEND} --backend=${BACKEND}
$TOOLS/compute_image_mean -backend=$BACKEND $EXAMPLE/mnist_train_$BACKEND $EXAMPLE/mean.binaryproto
GLOG_logtostderr=1 $TOOLS/convert_imageset --resize_height=4 --resize_width=4 --gray \
  $DATA/ $DATA/list.txt $EXAMPLE/images_lmdb
$TOOLS/caffe train --solver=$EXAMPLE/lenet_solver.prototxt $@
$TOOLS/caffe.bin test -model $EXAMPLE/net.prototxt -weights $EXAMPLE/lenet_iter_2.caffemodel -iterations 1
