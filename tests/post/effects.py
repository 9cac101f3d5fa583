"""What the tests of the effects share: numbers of a config, values inside their range."""

import torch

from torchblur.params import declared


def numbers(effect_class, grad):
    """Return the declared numbers of one gradient class, by name."""
    specs = declared(effect_class.config_class)
    return {
        name: spec for name, spec in specs.items() if spec.grad == grad and spec.low is not None
    }


def inside(spec, value, step=0.05):
    """Return a value some way from the given one, and from both ends of the range."""
    unit = spec.to_unit(torch.tensor(float(value), dtype=torch.float64))
    unit = unit + step if float(unit) < 0.5 else unit - step
    return spec.from_unit(unit.clamp(0.11, 0.89))


def check_gradient(run, value):
    """Gradcheck a function of one parameter, and that its gradient is not zero."""
    value = value.clone().requires_grad_()
    noise = torch.rand_like(run(value))  # one number out: a failure is reported without a wait

    def total(v):
        return (run(v) * noise).sum()

    assert torch.autograd.gradcheck(total, (value,), eps=1e-6, atol=1e-4, rtol=1e-3)
    (grad,) = torch.autograd.grad(run(value).square().mean(), value)
    assert float(grad.abs().sum()) > 1e-8


def slopes(run, spec, value, step=0.1):
    """Return autograd's slope and the finite difference over the unit range, of the mean square."""
    middle = spec.to_unit(inside(spec, value))
    unit = middle.clone().requires_grad_()
    result = run(spec.from_unit(unit)).square().mean()
    slope = 0.0
    if result.requires_grad:
        (grad,) = torch.autograd.grad(result, unit, allow_unused=True)
        slope = 0.0 if grad is None else float(grad)
    with torch.no_grad():
        below, above = (
            float(run(spec.from_unit(middle + s)).square().mean()) for s in (-step, step)
        )
    return slope, (above - below) / (2 * step)
