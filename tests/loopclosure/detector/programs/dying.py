import os, signal, sys
import numpy as np
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector.map import Map
from loopclosure.detector.run import run_detector
from loopclosure.places.sequences import read_sequence
save = np.savez
def dying(*arrays, **named):
    save(*arrays, **named)
    os.kill(os.getpid(), signal.SIGKILL)
np.savez = dying
Map(sys.argv[1]).add(read_sequence(sys.argv[2]), Thumbnailer())
