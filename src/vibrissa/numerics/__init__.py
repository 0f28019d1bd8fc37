"""Array types, compilation of kernels, threads, and small linear systems.

Modules that need Numba or xarray are imported on first use, so that array types cost nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vibrissa.deferred import names_from
from vibrissa.numerics.arrays import (
    AnyArray,
    Array,
    Call as Call,
    IntArray,
    Mask as Mask,
    Vector,
    contact_weights as contact_weights,
    contacts_in as contacts_in,
    cross as cross,
    cross_matrix as cross_matrix,
    exponential as exponential,
    numbers as numbers,
    on_one_core as on_one_core,
    relative as relative,
    rotation_matrices as rotation_matrices,
    share_out as share_out,
    small_over_large as small_over_large,
    spherical as spherical,
    threads as threads,
    vectors as vectors,
    weighted_quantile as weighted_quantile,
    without_blas_threads as without_blas_threads,
)

if TYPE_CHECKING:
    from vibrissa.numerics.algebra import (
        cholesky,
        forward as forward,
        mahalanobis as mahalanobis,
        norm3 as norm3,
        order_of as order_of,
        quick_exp as quick_exp,
        solve,
        solve3 as solve3,
        solve_root as solve_root,
        wrapped as wrapped,
    )
    from vibrissa.numerics.compiled import (
        copy,
        inlined as inlined,
        inlined_rigorous as inlined_rigorous,
        kernel as kernel,
        rigorous as rigorous,
        shared as shared,
        specialised as specialised,
        vectorised as vectorised,
    )
    from vibrissa.numerics.device import Translation as Translation, check_device as check_device
    from vibrissa.numerics.kernel_cache import compile_together as compile_together

__all__ = ["AnyArray", "Array", "IntArray", "Vector", "cholesky", "copy", "solve"]
__dir__ = __all__.copy

__getattr__ = names_from(
    __name__,
    {
        "algebra": (
            "cholesky forward mahalanobis norm3 order_of quick_exp solve solve3 solve_root wrapped"
        ),
        "compiled": "copy inlined inlined_rigorous kernel rigorous shared specialised vectorised",
        "device": "Translation check_device",
        "kernel_cache": "compile_together",
    },
)
