"""Transfer functions at many values: one program, where operation by operation each would be one."""

import jax


@jax.jit
def look_up(transfer, quantity):
    """Colour and extinction."""
    return transfer(quantity)


@jax.jit
def look_ups(transfers, quantities):
    """The same of several, each at its own values."""
    return [transfer(quantity) for transfer, quantity in zip(transfers, quantities, strict=True)]
