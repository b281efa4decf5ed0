import os, signal, sys
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector import map as maps
from loopclosure.places.sequences import read_sequence

def dying(*arguments):
    os.kill(os.getpid(), signal.SIGKILL)

maps.write_loops_csv = dying
maps.Map(sys.argv[1]).add(read_sequence(sys.argv[2]), Thumbnailer())
