"""The same network, faster on CPUs: compiled kernels behind the plain PyTorch form, which GPUs run and tests compare with."""
