import multiprocessing as mp, sys
import caffe

def phases(_):
    import helper
    return len({caffe.TRAIN, caffe.TEST}), helper.half(3), 3 / 2

if __name__ == "__main__":
    for kind in sys.argv[1:]:
        pool = mp.get_context(kind).Pool(1)
        %s
        pool.terminate()
