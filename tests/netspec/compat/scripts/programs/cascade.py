import caffe, cv2, time
import numpy as np

def boxes_of(map, reg, scale, threshold):
    (x, y) = np.where(map.T >= threshold)
    score = map.T[x, y]
    found = np.array([y, x]).T
    low = np.fix((2 * found + 1) / scale).T
    high = np.fix((2 * found + 12) / scale).T
    return np.concatenate((low, high, [score], [reg[i].T[x, y] for i in range(4)]), axis=0).T

caffe.set_mode_cpu()
PNet = caffe.Net('det1.prototxt', 'det1.caffemodel', caffe.TEST)
img = cv2.imread('image.png').astype(np.float)
h, w = img.shape[0], img.shape[1]
scale, total, outs = 12.0 / 20, np.zeros((0, 9), np.float), []
tic = time.perf_counter()
while min(h, w) * scale >= 12:
    hs, ws = int(np.ceil(h * scale)), int(np.ceil(w * scale))
    im_data = np.swapaxes((cv2.resize(img, (ws, hs)) - 127.5) * 0.0078125, 0, 2)
    PNet.blobs['data'].reshape(1, 3, ws, hs)
    PNet.blobs['data'].data[...] = np.array([im_data], dtype=np.float)
    out = PNet.forward()
    outs.append(out['prob1'])
    total = np.concatenate((total, boxes_of(out['prob1'][0, 1, :, :], out['conv4-2'][0], scale, 0.5)), axis=0)
    print(ws, hs, out['prob1'].shape, ' '.join(sorted(out.keys())))
    scale *= 0.709
print(total.shape[0] > 0, time.perf_counter() >= tic, 'pool1' in PNet.blobs)
print('%.4f' % total[:, 4].mean())
