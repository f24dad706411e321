"""Links the objects of compiled kernels into the library for a wheel."""

from __future__ import annotations

import hashlib
import importlib
import json
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from llvmlite import binding, ir

from cavmarl.core.compiled.address_tables import tables
from cavmarl.core.compiled.kernel_files import CompiledKernel, numba_version
from cavmarl.core.compiled.library import (
    FORMAT,
    INDEX_FILE,
    LEVEL_SYMBOL,
    LIBRARY_FILE,
    index_digest,
    python_tag,
)
from cavmarl.core.compiled.sources import module_digest
from cavmarl.core.errors import KernelError

# The target of a wheel: Intel or AMD processors since about 2013 (Haswell, Excavator).
PROCESSOR = "x86-64-v3" if platform.machine() in ("x86_64", "AMD64") else "generic"
FEATURES = {
    "x86-64-v3": "+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+cx16,+sahf,+avx,+avx2,+bmi,+bmi2,+f16c,"
    "+fma,+lzcnt,+movbe,+xsave,+crc32,+fxsr,+mmx,+cx8,+x87",
    "generic": "",
}[PROCESSOR]


def find_linker() -> list[str]:
    """Return the command of a C compiler that can link.

    Raises:
        KernelError: this machine has no C compiler.
    """
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return [found]
    if find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc"]
    raise KernelError(
        "no C compiler to link the kernels: install gcc or clang, or run `pip install ziglang`"
    )


def link(kernels: Sequence[CompiledKernel], folder: Path) -> None:
    """Write the library of some kernels, and its index, into a folder.

    Raises:
        KernelError: there is no linker, or it failed.
    """
    for kernel in kernels:  # a module that uses tables of addresses also defines these tables
        importlib.import_module(kernel.name.rpartition(".")[0])
    folder.mkdir(parents=True, exist_ok=True)
    library = folder / LIBRARY_FILE
    with TemporaryDirectory() as scratch:
        objects = [
            Path(scratch, "common.o"),
            *(Path(scratch, f"{k}.o") for k in range(len(kernels))),
        ]
        for path, code in zip(objects, [_common_object(), *(k.code for k in kernels)], strict=True):
            path.write_bytes(code)
        exported = Path(scratch, "exported")
        exported.write_text("{ global: cavmarl_*; local: *; };\n")
        listed = Path(scratch, "objects")
        listed.write_text("\n".join(map(str, objects)))
        command = [
            *find_linker(), "-shared", f"-Wl,--version-script={exported}", "-Wl,--gc-sections",
            "-Wl,-z,noexecstack,-z,defs", "-s", "-o", str(library), f"@{listed}", "-lm",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise KernelError(f"{command[0]} could not link the kernels: {done.stderr.strip()}")
    index = _index_of(kernels)
    index["sha256"] = hashlib.sha256(library.read_bytes()).hexdigest()
    index["index_sha256"] = index_digest(index)
    (folder / INDEX_FILE).write_text(json.dumps(index, sort_keys=True))


def _index_of(kernels: Iterable[CompiledKernel]) -> dict[str, Any]:
    found: dict[str, dict[str, list[str]]] = {}
    for kernel in kernels:
        found.setdefault(kernel.name, {})[kernel.types] = [kernel.symbol, kernel.result]
    modules = {name.rpartition(".")[0] for name in found}
    return {
        "format": FORMAT,
        "processor": PROCESSOR,
        "python": python_tag(),
        "numba": numba_version(),
        "modules": {module: module_digest(module) for module in sorted(modules)},
        "kernels": found,
    }


def _common_object() -> bytes:
    """Return the common object: tables of addresses, and a function that queries the processor.

    Its code targets the oldest x86-64, because it runs before the processor is known.
    """
    module = ir.Module("common")
    module.triple = binding.get_process_triple()
    for table in tables:
        kind = ir.ArrayType(ir.IntType(64), table.size)
        variable = ir.GlobalVariable(module, kind, table.symbol)
        variable.initializer = ir.Constant(kind, None)
    if PROCESSOR == "x86-64-v3":
        _add_level_function(module)
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    binding.initialize_native_asmparser()
    parsed = binding.parse_assembly(str(module))
    machine = binding.Target.from_triple(binding.get_process_triple()).create_target_machine(
        cpu="x86-64" if PROCESSOR == "x86-64-v3" else PROCESSOR, reloc="pic", codemodel="default"
    )
    code: bytes = machine.emit_object(parsed)
    return code


def _add_level_function(module: ir.Module) -> None:
    word, long = ir.IntType(32), ir.IntType(64)
    kind = ir.FunctionType(ir.VoidType(), [long.as_pointer()])
    function = ir.Function(module, kind, LEVEL_SYMBOL)
    builder = ir.IRBuilder(function.append_basic_block())
    four = ir.LiteralStructType([word] * 4)
    changes = "~{dirflag},~{fpsr},~{flags}"
    constraint = f"={{ax}},={{bx}},={{cx}},={{dx}},{{ax}},{{cx}},{changes}"
    question = ir.InlineAsm(ir.FunctionType(four, [word, word]), "cpuid", constraint, True)

    def ask(leaf: int, register: int) -> Any:
        answer = builder.call(question, [word(leaf), word(0)])
        return builder.extract_value(answer, register)

    first = ask(1, 2)
    values = [first, ask(7, 1), ask(0x80000001, 2)]
    # Without OSXSAVE, the instruction `xgetbv` does not exist.
    pair = ir.LiteralStructType([word, word])
    saved = ir.InlineAsm(
        ir.FunctionType(pair, [word]),
        "xgetbv",
        "={ax},={dx},{cx},~{dirflag},~{fpsr},~{flags}",
        True,
    )
    has_it = builder.trunc(builder.lshr(first, word(27)), ir.IntType(1))
    place = builder.alloca(word)
    builder.store(word(0), place)
    with builder.if_then(has_it):
        answer = builder.call(saved, [word(0)])
        builder.store(builder.extract_value(answer, 0), place)
    values.append(builder.load(place))
    for at, value in enumerate(values):
        target = builder.gep(function.args[0], [long(at)])
        builder.store(builder.zext(value, long), target)
    builder.ret_void()
