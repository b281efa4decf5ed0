import sys, math
import numpy as np
w = np.ones((3, 1), np.float32)
print("%.2f %s %d" % (w[0], "a", w[1]), "%.1f" % w[2], float(w[0]) + int(w[1]), math.sqrt(w[0]))
np.set_printoptions(threshold="nan")
print(len(str(np.zeros(2000))) > 2000)
for fault in (lambda: "%d" % "a", lambda: float([1]), lambda: "%.2f" % np.ones(2)):
    try:
        fault()
    except TypeError as e:
        print(e)
