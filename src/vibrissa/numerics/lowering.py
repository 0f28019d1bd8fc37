"""How what kernels do becomes LLVM's instructions: Numba's own way, with fewer of them.

Two thirds of compiling is Numba's own work, and LLVM's first look at what it wrote, both in
proportion to the instructions. Most of these only pack and unpack arrays, so here elements are read
and written where the array is, variables that own nothing are not emptied when they end, and
references are neither counted for arguments, which callers keep, nor looked for in numbers. LLVM
makes the same machine code of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.core import cgutils, ir
from numba.core.compiler_machinery import register_pass
from numba.core.cpu import CPUContext
from numba.core.lowering import Lower
from numba.core.runtime.context import NRTContext
from numba.core.typed_passes import NativeLowering
from numba.np.arrayobj import fix_integer_index, load_item, mark_positive, store_item


class _References(NRTContext):
    """Counting references, looking at nothing of an array but whose it is."""

    def get_meminfos(self, builder: Any, ty: Any, val: Any) -> list[Any]:
        """List the owners of the arrays in a value."""
        models = self._context.data_model_manager
        model = models[ty]
        if model.has_nrt_meminfo():
            return [(ty, model.get_nrt_meminfo(builder, val))]
        return [
            owner
            for kind, member in model.traverse(builder)
            if models[kind].contains_nrt_meminfo()
            for owner in self.get_meminfos(builder, kind, member(val))
        ]


class KernelContext(CPUContext):
    """What compiles kernels."""

    @property
    def nrt(self) -> NRTContext:
        """Counter of references."""
        return _References(self, self.enable_nrt)  # type: ignore[no-untyped-call]


class _Brief(Lower):
    def init(self) -> None:
        """Find which variables are arguments, which callers keep for as long as the call takes."""
        super().init()  # type: ignore[no-untyped-call]
        made: dict[str, list[Any]] = {}
        for block in self.blocks.values():
            for statement in block.find_insts(ir.Assign):
                made.setdefault(statement.target.name, []).append(statement.value)
        self._arguments = {
            name
            for name, (value, *more) in made.items()
            if isinstance(value, ir.Arg) and not more and not self._disable_sroa_like_opt
        }
        self._lent = False

    def lower_assign(self, ty: Any, inst: Any) -> Any:
        self._lent = inst.target.name in self._arguments
        value = super().lower_assign(ty, inst)  # type: ignore[no-untyped-call]
        self._lent = False
        return value

    def incref(self, typ: Any, val: Any) -> None:
        if not self._lent:
            super().incref(typ, val)  # type: ignore[no-untyped-call]

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        if self._counted(name):
            super().storevar(value, name, argidx)  # type: ignore[no-untyped-call]
            return
        self._alloca_var(name, self.typeof(name))  # type: ignore[no-untyped-call]
        if name in self._singly_assigned_vars:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))  # type: ignore[no-untyped-call]

    def delvar(self, name: str) -> None:
        if self._counted(name):
            super().delvar(name)  # type: ignore[no-untyped-call]
        elif name not in self._blk_local_varmap:
            self._singly_assigned_vars.discard(name)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        if expr.op in ("getitem", "static_getitem"):
            index = expr.index if expr.op == "getitem" else expr.index_var
            pointer = self._element(expr.value, index)
            if pointer is not None:
                kind = self.typeof(expr.value.name)  # type: ignore[no-untyped-call]
                item = load_item(self.context, self.builder, kind, pointer)
                return self.context.cast(self.builder, item, kind.dtype, resty)
        return super().lower_expr(resty, expr)  # type: ignore[no-untyped-call]

    def lower_inst(self, inst: Any) -> None:
        if isinstance(inst, ir.SetItem | ir.StaticSetItem):
            index = inst.index if isinstance(inst, ir.SetItem) else inst.index_var
            given = self.typeof(inst.value.name)  # type: ignore[no-untyped-call]
            simple = isinstance(given, types.Number | types.Boolean)
            pointer = self._element(inst.target, index) if simple else None
            if pointer is not None:
                kind = self.typeof(inst.target.name)  # type: ignore[no-untyped-call]
                value = self.loadvar(inst.value.name)  # type: ignore[no-untyped-call]
                value = self.context.cast(self.builder, value, given, kind.dtype)
                store_item(self.context, self.builder, kind, value, pointer)
                return
        super().lower_inst(inst)  # type: ignore[no-untyped-call]

    def _counted(self, name: str) -> bool:
        """Whether Numba must store a variable itself: references are counted, or it is debugged."""
        kind = self.typeof(name)  # type: ignore[no-untyped-call]
        model = self.context.data_model_manager[kind]
        counted = self.context.enable_nrt and name not in self._arguments
        return self._disable_sroa_like_opt or bool(counted and model.contains_nrt_meminfo())

    def _element(self, array: Any, index: Any) -> Any:
        """Point to an element of an array; None where it is not one element."""
        if index is None:
            return None
        context, builder = self.context, self.builder
        kind, by = self.typeof(array.name), self.typeof(index.name)  # type: ignore[no-untyped-call]
        several = isinstance(by, types.BaseTuple)
        axes = [types.unliteral(axis) for axis in (by.types if several else (by,))]
        if (
            type(kind) is not types.Array
            or len(axes) != kind.ndim
            or not all(isinstance(axis, types.Integer) for axis in axes)
            or not isinstance(kind.dtype, types.Number | types.Boolean)
            or context.enable_boundscheck
        ):
            return None
        part = self._fields(array.name, kind)
        shape = [part("shape", a) for a in range(kind.ndim)]
        strides = [] if kind.layout in "CF" else [part("strides", a) for a in range(kind.ndim)]
        which = self.loadvar(index.name)  # type: ignore[no-untyped-call]
        each = [builder.extract_value(which, a) for a in range(len(axes))] if several else [which]
        wrapped = [
            fix_integer_index(context, builder, *row) for row in zip(axes, each, shape, strict=True)
        ]
        return cgutils.get_item_pointer2(
            context, builder, part("data"), shape, strides, kind.layout, wrapped
        )

    def _fields(self, name: str, kind: Any) -> Callable[..., Any]:
        """Give what reads a field of an array, where the array is."""
        builder, field = self.builder, self.context.data_model_manager[kind].get_field_position
        if name in self._blk_local_varmap:
            value = self._blk_local_varmap[name]
            return lambda what, *axis: builder.extract_value(value, [field(what), *axis])
        slot = self.getvar(name)  # type: ignore[no-untyped-call]

        def part(what: str, *axis: int) -> Any:
            where = cgutils.gep_inbounds(builder, slot, 0, field(what), *axis)
            loaded = builder.load(where)
            if what == "shape":
                mark_positive(builder, loaded)
            return loaded

        return part


@register_pass(mutates_CFG=True, analysis_only=False)
class BriefLowering(NativeLowering):
    """Lowering with fewer instructions."""

    _name = "brief_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        """Numba's, changed."""
        return _Brief
