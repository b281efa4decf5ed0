import sys, cv2, numpy as np
prototxt, weights, data, out = sys.argv[1:]
net = cv2.dnn.readNetFromCaffe(prototxt, weights)
net.enableFusion("folded" in prototxt)  # its own folding gets grouped deconvolutions wrong
net.setInput(np.load(data))
np.save(out, net.forward())
