"""Code that Numba compiles. Take `njit` from here: importing this room names the folder where compiled code is kept."""

from numba import njit, prange

from stages.avatar.kernels import cache

__all__ = ["cache", "njit", "prange"]
