import gc, signal
import netspec, numpy as np

def load(precision):
    net = netspec.load_net("net.prototxt", weights="net.caffemodel", engine="openvino", precision=precision)
    net(data=np.zeros((2, 3, 12, 12), np.float32))
    return net

heard = []
signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
for precision in ("fp32", "bf16"):
    first, second = load(precision), load(precision)
    del first
    gc.collect()
    del second
    gc.collect()
    signal.raise_signal(signal.SIGTERM)
assert heard == [signal.SIGTERM] * 2
