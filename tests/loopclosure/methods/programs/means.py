import cv2

def describe(image):
    return cv2.resize(image, (8, 6), interpolation=cv2.INTER_AREA).reshape(-1) / 255.0

def growing(image, sizes=[]):
    sizes.append(1)
    return sizes
