"""PTX, as NVRTC emits it, to C++ that runs on simt.h: what the compiler made of a kernel is then what a test runs.

Each instruction becomes a call of a function of ptx.h, which says what it computes; here is which function and what
its operands are. An instruction, modifier or declaration that is not known is an error. What ptxas makes of the PTX is
not seen: it may still join a multiplication and an addition that bear no ``.rn``.
"""

import re
from dataclasses import dataclass, field

_TYPES = {
    **{f"{kind}{bits}": f"uint{bits}_t" for kind in "ub" for bits in (8, 16, 32, 64)},
    **{f"s{bits}": f"int{bits}_t" for bits in (8, 16, 32, 64)},
    "f32": "float",
    "f64": "double",
    "pred": "bool",
}
_SIZES = {name: 1 if name == "pred" else int(name[1:]) // 8 for name in _TYPES}
MOST_SHARED = 48 << 10

# Instruction without its type: the function of ptx.h and the types of what it takes, "t" that of the instruction.
_FUNCTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    **{name: (name, ("t", "t")) for name in ("add", "sub", "mul", "div", "rem", "min", "max")},
    **{f"{name}.rn": (name, ("t", "t")) for name in ("add", "sub", "mul", "div")},
    **{f"div.{how}": ("div", ("t", "t")) for how in ("full", "approx")},
    **{name: (f"{name}_", ("t", "t")) for name in ("and", "or", "xor")},
    **{name: (name, ("t",)) for name in ("neg", "abs", "brev", "popc", "clz")},
    **{f"mul.{part}": (f"mul_{part}", ("t", "t")) for part in ("lo", "hi", "wide")},
    **{f"{name}.{how}": (name, ("t",)) for name in ("rcp", "sqrt") for how in ("rn", "approx")},
    **{
        f"setp.{how}": (f"is_{how}", ("t", "t"))
        for how in ["eq", "ne", "lt", "le", "gt", "ge", "equ", "neu", "ltu", "leu", "gtu", "geu"]
    },
    **{f"vote.sync.{how}": (f"vote_{how}", ("pred", "u32")) for how in ("ballot", "any", "all")},
    **{f"shfl.sync.{how}": (f"shfl_{how}", ("u32",) * 4) for how in ("up", "down", "bfly", "idx")},
    **{f"bar.red.{how}": (f"bar_{how}", ("u32", "pred")) for how in ("or", "and", "popc")},
    "not": ("not_", ("t",)),
    "mad.lo": ("mad_lo", ("t", "t", "t")),
    "fma.rn": ("fma", ("t", "t", "t")),
    "selp": ("selp", ("t", "t", "pred")),
    "shl": ("shl", ("t", "u32")),
    "shr": ("shr", ("t", "u32")),
    "ex2.approx": ("ex2", ("t",)),
    "lg2.approx": ("lg2", ("t",)),
    "bfind.shiftamt": ("bfind_shiftamt", ("t",)),
    "bfi": ("bfi", ("t", "t", "u32", "u32")),
    "prmt": ("prmt", ("t", "t", "t")),
    "shf.l.wrap": ("shf_l_wrap", ("t", "t", "u32")),
    "match.any.sync": ("match_any", ("t", "u32")),
}
_ROUNDINGS = ("rn", "rz", "rzi", "rni", "rmi", "rpi")
_SPACES = ("global", "shared", "local", "param")
_ATOMICS = ("add", "min", "max", "and", "or", "exch", "cas")
_SPECIAL = {"tid": "threadIdx", "ntid": "blockDim", "ctaid": "blockIdx", "nctaid": "gridDim"}

_NAME = r"[\w$]+"
_ENTRY = re.compile(
    rf"\.entry\s+({_NAME})\s*\((.*?)\)\s*(?:\.maxntid\s+(\d+), (\d+), (\d+)\s*)?(\{{.*?^\}})", re.S | re.M
)
_PARAMETER = re.compile(rf"\.param\s+(?:\.align\s+(\d+)\s+)?\.(\w+)\s+({_NAME})(?:\[(\d+)\])?")
_REGISTERS = re.compile(r"\.reg\s+\.(\w+)\s+(.+)", re.S)
_VARIABLE = re.compile(
    rf"\.(global|const|shared|local)\s+\.align\s+(\d+)\s+\.(\w+)\s+({_NAME})(?:\[(\d+)\])?(?:\s*=\s*(.+))?", re.S
)
_MEMORY = re.compile(rf"\[(%?{_NAME})(?:\+(-?\d+))?\]$")


class PtxError(ValueError):
    """What this translator does not know."""


@dataclass
class _Block:
    """Variables in one space of memory, one after the other."""

    size: int = 0
    offsets: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, size: int, alignment: int) -> int:
        self.offsets[name] = offset = -(-self.size // alignment) * alignment
        self.size = offset + size
        return offset


def translate(ptx: str) -> str:
    """C++ with what `simt.h` exports of a kernel, for each entry of the PTX."""
    text = re.sub(r"//[^\n]*", "", ptx)
    kernels = [_Kernel(match) for match in _ENTRY.finditer(text)]
    if not kernels:
        raise PtxError("no kernel")
    outside = _ENTRY.sub("", text)
    code = "".join(kernel.code for kernel in kernels)
    found = (_VARIABLE.search(statement) for statement in outside.split(";"))
    variables = [_global_variable(match) for match in found if match and match[4] in code]
    return "\n".join(['#include "simt.h"', '#include "ptx.h"', *variables, *(kernel.definition for kernel in kernels)])


def _global_variable(match: re.Match[str]) -> str:
    space, alignment, kind, name, count, value = match.groups()
    if space not in ("global", "const"):
        raise PtxError(f"{name}: {space} memory of no kernel")
    initial = value.strip() if value else "{}"
    if initial.startswith("0f"):
        initial = _literal(initial)
    return f"alignas({alignment}) static {_TYPES[kind]} {_cpp(name)}{f'[{count}]' if count else ''} = {initial};"


def _cpp(name: str) -> str:
    return name.replace("%", "r_").replace("$", "s_").replace(".", "_")


def _literal(text: str) -> str | None:
    """A number as C++, or None for what is none."""
    if re.fullmatch(r"0f[0-9A-Fa-f]{8}", text):
        return f"std::bit_cast<float>(uint32_t{{0x{text[2:]}}})"
    if re.fullmatch(r"0d[0-9A-Fa-f]{16}", text):
        return f"std::bit_cast<double>(uint64_t{{0x{text[2:]}}})"
    if re.fullmatch(r"-?\d+|0x[0-9A-Fa-f]+", text):
        return f"static_cast<int64_t>(0x{int(text, 0) % 2**64:x}u)"
    return None


def _operands(text: str) -> list[str]:
    """Split at commas that are not within braces or brackets."""
    return [part.strip() for part in re.findall(r"(?:\{[^}]*\}|\[[^\]]*\]|[^,])+", text)]


class _Kernel:
    """One entry: its code, and what is around it."""

    def __init__(self, match: re.Match[str]) -> None:
        self.name = match[1]
        self._most = [int(size) for size in match.groups()[2:5]] if match[3] else [1024]
        self._parameters, self._shared, self._local = _Block(), _Block(), _Block()
        self._sizes = [self._add_parameter(parameter) for parameter in _PARAMETER.finditer(match[2])]
        self._declared: list[str] = []
        self._prefixes: set[str] = set()
        statements = re.sub(r"^(\$\w+):", r"\1:;", match[6].strip()[1:-1], flags=re.M).split(";")
        self.code = "\n".join(filter(None, (self._statement(statement.strip()) for statement in statements)))
        if self._shared.size > MOST_SHARED:
            raise PtxError(f"{self.name}: {self._shared.size} bytes of shared memory")

    def _add_parameter(self, match: re.Match[str]) -> int:
        alignment, kind, name, count = match.groups()
        size = int(count or 1) * _SIZES[kind]
        self._parameters.add(name, size, int(alignment or _SIZES[kind]))
        return size

    @property
    def definition(self) -> str:
        """The kernel as a function, and what is exported of it."""
        arrays, most = "", 1
        for size in self._most:
            most *= size
        if self._shared.size:
            attributes = 'alignas(256) static __attribute__((section("simt_shared")))'
            arrays += f"{attributes} unsigned char {self.name}_shared[{self._shared.size}];\n"
        if self._parameters.size:
            arrays += f"alignas(64) static unsigned char {self.name}_parameters[{self._parameters.size}];\n"
        local = f"ptx::Local<{self._local.size}> local;\n" if self._local.size else ""
        offsets = "".join(f"{offset}, " for offset in self._parameters.offsets.values())
        sizes = "".join(f"{size}, " for size in self._sizes)
        return (
            f"{arrays}static void {self.name}() {{\n{local}{' '.join(self._declared)}\n{self.code}\n}}\n"
            f"PTX_EXPORT({self.name}, {most}, {f'{self.name}_parameters' if sizes else 'nullptr'}, "
            f"PTX_LIST({sizes}0), PTX_LIST({offsets}0))\n"
        )

    def _statement(self, text: str) -> str:
        if text[:1] in ("{", "}"):
            return f"{text[0]}\n{self._statement(text[1:].strip())}"
        if not text or text.startswith(".pragma"):
            return ""
        if text.endswith(":"):
            return f"{_cpp(text)};"
        if registers := _REGISTERS.fullmatch(text):
            return self._registers(*registers.groups())
        if variable := _VARIABLE.fullmatch(text):
            space, alignment, kind, name, count, _ = variable.groups()
            block = {"shared": self._shared, "local": self._local}[space]
            block.add(name, int(count or 1) * _SIZES[kind], int(alignment))
            return ""
        instruction = re.fullmatch(r"(?:@(!?)(%\w+)\s+)?([a-z][\w.]*(?:::\w+)?)\s*(.*)", text, re.S)
        if not instruction:
            raise PtxError(f"{self.name}: {text}")
        negated, guard, opcode, rest = instruction.groups()
        code = self._instruction(opcode, _operands(rest))
        return f"if ({negated}{_cpp(guard)}) {{ {code} }}" if guard else code

    def _registers(self, kind: str, names: str) -> str:
        """Those of a kernel are declared at its beginning, which no jump crosses; others where they are."""
        plain: list[str] = []
        self._prefixes |= {re.sub(r"(<\d+>|\d+)$", "", name.strip()) for name in names.split(",")}
        for name in names.split(","):
            numbered = re.fullmatch(r"(%\w+)<(\d+)>", name.strip())
            if numbered:
                all_of_them = ", ".join(f"{_cpp(numbered[1])}{i} = {{}}" for i in range(int(numbered[2])))
                self._declared.append(f"{_TYPES[kind]} {all_of_them};")
            else:
                plain.append(_cpp(name.strip()))
        if plain and plain[0] in ("r_SP", "r_SPL"):
            self._declared += [f"{_TYPES[kind]} {name} = {{}};" for name in plain]
            return ""
        return f"{_TYPES[kind]} {', '.join(plain)};" if plain else ""

    # Operands

    def _value(self, operand: str, kind: str) -> str:
        """An operand as C++ of a type."""
        special = re.fullmatch(r"%(n?tid|n?ctaid)\.([xyz])", operand)
        if special:
            expression = f"{_SPECIAL[special[1]]}.{special[2]}"
        elif re.fullmatch(r"%\w+", operand) and operand.rstrip("0123456789") in self._prefixes:
            expression = _cpp(operand)
        elif operand.startswith("%"):
            raise PtxError(f"{self.name}: {operand} is not known")
        else:
            expression = _literal(operand) or self._address(operand)
        return f"ptx::as<{_TYPES[kind]}>({expression})"

    def _address(self, name: str) -> str:
        """Of a variable: an offset for those in shared memory, as on a device, else where it is."""
        if name in self._shared.offsets:
            return f"uint64_t{{{self._shared.offsets[name]}}}"
        if name in self._local.offsets:
            return f"ptx::address_of(local.bytes + {self._local.offsets[name]})"
        if name in self._parameters.offsets:
            return f"ptx::address_of({self.name}_parameters + {self._parameters.offsets[name]})"
        return f"ptx::address_of(&{_cpp(name)})"

    def _pointer(self, operand: str, space: str, kind: str, count: int) -> str:
        """What a memory operand points to, looked at for its alignment and, where its space is small, for its place."""
        match = _MEMORY.fullmatch(operand)
        if not match:
            raise PtxError(f"{self.name}: {operand}")
        base = f"{self._value(match[1], 'u64')} + {match[2] or 0}"
        room = {
            "shared": f"{self.name}_shared" if self._shared.size else "",
            "local": "local.bytes" if self._local.size else "",
            "param": f"{self.name}_parameters",
        }.get(space, "")
        if space in ("global", "generic"):
            return f"ptx::at<{_TYPES[kind]}, {count}>({base})"
        if not room:
            raise PtxError(f"{self.name}: {operand} in {space} memory, of which there is none")
        return f"ptx::within{'_shared' if space == 'shared' else ''}<{_TYPES[kind]}, {count}>({room}, {base})"

    def _put(self, operand: str, value: str) -> str:
        return f"(void)({value});" if operand == "_" else f"ptx::put({_cpp(operand)}, {value});"

    # Instructions

    def _instruction(self, opcode: str, operands: list[str]) -> str:
        name, *modifiers = opcode.split(".")
        special = getattr(self, f"_{name}", None)
        if special:
            return special(modifiers, operands)
        *modifiers, kind = modifiers or [""]
        flush = "ftz" in modifiers
        key = ".".join([name, *(modifier for modifier in modifiers if modifier != "ftz")])
        if key not in _FUNCTIONS or kind not in _TYPES:
            raise PtxError(f"{self.name}: {opcode} is not known")
        function, kinds = _FUNCTIONS[key]
        target, *sources = operands
        if len(sources) != len(kinds):
            raise PtxError(f"{self.name}: {opcode} {', '.join(operands)}")
        values = [self._value(source, kind if k == "t" else k) for source, k in zip(sources, kinds, strict=True)]
        if flush:
            values = [f"ptx::flush({value})" if k == "t" else value for value, k in zip(values, kinds, strict=True)]
        if name == "shfl":
            target, _, inside = target.partition("|")
            values.append(_cpp(inside) if inside else "ptx::ignored")
        call = f"ptx::{function}({', '.join(values)})"
        return self._put(target, f"ptx::flush({call})" if flush and name != "setp" else call)

    def _ret(self, modifiers: list[str], operands: list[str]) -> str:
        return "return;"

    def _bra(self, modifiers: list[str], operands: list[str]) -> str:
        return f"goto {_cpp(operands[0])};"

    def _bar(self, modifiers: list[str], operands: list[str]) -> str:
        if modifiers[:2] == ["warp", "sync"]:
            return f"__syncwarp({self._value(operands[0], 'u32')});"
        if modifiers == ["sync"] and operands == ["0"]:
            return "__syncthreads();"
        if modifiers[0] == "red" and operands[1] == "0":
            function, _ = _FUNCTIONS[f"bar.red.{modifiers[1]}"]
            return self._put(operands[0], f"ptx::{function}({self._value(operands[2], 'pred')})")
        raise PtxError(f"{self.name}: bar.{'.'.join(modifiers)} {', '.join(operands)}")

    def _mov(self, modifiers: list[str], operands: list[str]) -> str:
        (kind,) = modifiers
        target, source = operands
        if target.startswith("{"):
            parts = _operands(target[1:-1])
            half = f"b{_SIZES[kind] * 8 // len(parts)}"
            bits = f"const auto bits = {self._value(source, kind)};"
            shifts = (f"static_cast<{_TYPES[half]}>(bits >> {i * int(half[1:])})" for i in range(len(parts)))
            return f"{{ {bits} {' '.join(map(self._put, parts, shifts))} }}"
        if source.startswith("{"):
            parts = _operands(source[1:-1])
            width = _SIZES[kind] * 8 // len(parts)
            shifted = (
                f"{_TYPES[kind]}({self._value(part, f'b{width}')}) << {i * width}" for i, part in enumerate(parts)
            )
            return self._put(target, " | ".join(shifted))
        return self._put(target, self._value(source, kind))

    def _cvta(self, modifiers: list[str], operands: list[str]) -> str:
        space = next(modifier for modifier in modifiers if modifier in _SPACES)
        value = self._value(operands[1], "u64")
        base = f"ptx::address_of({self.name}_shared)" if space == "shared" else "0"
        return self._put(operands[0], f"{value} {'-' if 'to' in modifiers else '+'} {base}")

    def _cvt(self, modifiers: list[str], operands: list[str]) -> str:
        *how, to, source = modifiers
        flush = "ptx::flush" if "ftz" in how else ""
        rounding = [modifier for modifier in how if modifier != "ftz"]
        if any(modifier not in _ROUNDINGS for modifier in rounding) or len(rounding) > 1:
            raise PtxError(f"{self.name}: cvt.{'.'.join(modifiers)} is not known")
        value = f"{flush}({self._value(operands[1], source)})"
        function = f"cvt_{rounding[0]}" if rounding else "cvt"
        return self._put(operands[0], f"{flush}(ptx::{function}<{_TYPES[to]}>({value}))")

    def _ld(self, modifiers: list[str], operands: list[str]) -> str:
        space, kind, count, qualifier = self._access(modifiers)
        parts = _operands(operands[0][1:-1]) if count > 1 else [operands[0]]
        pointer = f"const {qualifier}auto* from = {self._pointer(operands[1], space, kind, count)};"
        return f"{{ {pointer} {' '.join(self._put(part, f'from[{i}]') for i, part in enumerate(parts))} }}"

    def _st(self, modifiers: list[str], operands: list[str]) -> str:
        space, kind, count, qualifier = self._access(modifiers)
        parts = _operands(operands[1][1:-1]) if count > 1 else [operands[1]]
        pointer = f"{qualifier}auto* to = {self._pointer(operands[0], space, kind, count)};"
        return f"{{ {pointer} {' '.join(f'to[{i}] = {self._value(part, kind)};' for i, part in enumerate(parts))} }}"

    def _access(self, modifiers: list[str]) -> tuple[str, str, int, str]:
        """(space, type, how many, "volatile " or nothing) of a load or a store."""
        *how, kind = modifiers
        count = next((int(modifier[1]) for modifier in how if modifier in ("v2", "v4")), 1)
        space = next((modifier for modifier in how if modifier in _SPACES), "generic")
        unknown = set(how) - {"v2", "v4", "volatile", "nc", space}
        if unknown:
            raise PtxError(f"{self.name}: {'.'.join(modifiers)}: {', '.join(unknown)} of a load or store is not known")
        return space, kind, count, "volatile " if "volatile" in how else ""

    def _atom(self, modifiers: list[str], operands: list[str]) -> str:
        *how, operation, kind = modifiers
        space = how[0] if how else "generic"
        if operation not in _ATOMICS or how not in ([], ["global"], ["shared"]):
            raise PtxError(f"{self.name}: atom.{'.'.join(modifiers)} is not known")
        target, address, *sources = operands
        values = ", ".join([self._pointer(address, space, kind, 1), *(self._value(source, kind) for source in sources)])
        return self._put(target, f"ptx::atom_{operation}({values})")

    def _red(self, modifiers: list[str], operands: list[str]) -> str:
        return self._atom(modifiers, ["_", *operands])
