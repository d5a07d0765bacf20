"""Code that Numba compiles. Take `njit` from here: importing this package sets the folder that keeps compiled code."""

from numba import njit, prange

from stages.avatar.kernels import cache

__all__ = ["cache", "njit", "prange"]
