"""torchblur: differentiable, batched motion-blur filters in PyTorch."""
