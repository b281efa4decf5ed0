import gc, signal, sys
import netspec, numpy as np

def load():
    net = netspec.load_net("net.prototxt", weights="net.caffemodel", engine="openvino", precision=sys.argv[1])
    net(data=np.zeros((2, 3, 12, 12), np.float32))
    return net

heard = []
first, second = load(), load()
del first
gc.collect()
del second
gc.collect()
signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
signal.raise_signal(signal.SIGTERM)
assert heard == [signal.SIGTERM]
