"""Caffe's data: databases of Datums, lists of images, what happens to an image on its way. No torch in here."""
