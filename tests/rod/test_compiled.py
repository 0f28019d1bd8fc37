"""Compiling: said once, cached where possible, done without a cache where not."""

import subprocess
import sys
import textwrap

import pytest

from vibrissa.rod.compiled import copy


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
        env=environment or None,
    )


def test_the_first_compilation_says_what_it_is_doing_once():
    """A kernel that is in nobody's cache, made in a module of the package's name."""
    said = run(
        """
        from vibrissa.rod.compiled import kernel

        def twice(x):
            return 2.0 * x

        def thrice(x):
            return 3.0 * x

        for function in (twice, thrice):
            function.__module__ = "vibrissa.made_up"
            assert kernel(function)(2.0) in (4.0, 6.0)
        """
    )
    assert said.stderr.count("vibrissa: compiling kernels") == 1
    assert said.stdout == ""


def test_other_people_s_compilations_are_none_of_our_business():
    said = run(
        """
        import numba
        import vibrissa.rod

        @numba.njit
        def twice(x):
            return 2.0 * x

        assert twice(2.0) == 4.0
        """
    )
    assert "vibrissa" not in said.stderr


def test_where_nothing_can_be_written_kernels_are_compiled_without_a_cache():
    """As in a read-only installation without a home folder: numba then finds no place for one."""
    said = run(
        """
        from numba.core import caching

        # None of numba's places for a cache can be used.
        for locator in caching.CacheImpl._locator_classes:
            locator.from_function = classmethod(lambda cls, function, file: None)

        from vibrissa.rod.compiled import inlined, kernel

        @inlined
        def square(x):
            return x * x

        @kernel
        def fourth(x):
            return square(square(x))

        assert fourth(2.0) == 16.0

        import vibrissa as vb

        whisker = vb.Whisker.straight(40e-3)
        bent = vb.deflect(whisker, vb.PointForce(20e-3, 1e-6, 0.0))
        assert bent.status == vb.Status.OK
        """
    )
    assert "Error" not in said.stderr


def test_importing_the_package_loads_no_compiler():
    said = run(
        """
        import sys
        import vibrissa
        vibrissa.Status
        print([name for name in ("numba", "scipy", "xarray", "matplotlib") if name in sys.modules])
        """
    )
    assert said.stdout.strip() == "[]"


def test_what_is_inlined_cannot_be_called_from_python():
    """It has no wrapper for that; without this guard the interpreter would crash."""
    with pytest.raises(TypeError, match="copy can be called by kernels only"):
        copy([0.0], [1.0])
