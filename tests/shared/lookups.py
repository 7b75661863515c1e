"""Transfer functions at many values: one program, where operation by operation each would be one."""

import jax


@jax.jit
def look_up(transfer, quantity):
    """Colour and extinction."""
    return transfer(quantity)
