"""Networks: the U-Net, its input normalisation and the losses."""
