import numpy as np, skimage.io, skimage.color, skimage.transform
skimage.io.imsave("a.png", np.full((2, 3, 3), 255, np.uint8), check_contrast=False)
print(skimage.io.imread("a.png", as_grey=True).shape, skimage.color.rgb2grey is skimage.color.rgb2gray)
rescale = skimage.transform.rescale
print(rescale(np.zeros((4, 6, 3)), 0.5).shape, rescale(np.zeros((4, 6)), 2).shape, rescale(np.zeros((4, 6, 2)), 2, multichannel=False).shape)
