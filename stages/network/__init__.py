"""The network: U-Net, coefficient maps, losses, checkpoints, and prediction of maps in strips."""
