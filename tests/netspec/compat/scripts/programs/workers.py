import multiprocessing as mp, sys
import numpy as np
import caffe

def phases(_):
    import helper
    return len({caffe.TRAIN, caffe.TEST}), helper.half(3), np.float is float

if __name__ == "__main__":
    for kind in sys.argv[1:]:
        pool = mp.get_context(kind).Pool(1)
        print(pool.map(phases, [0]))
        pool.terminate()
