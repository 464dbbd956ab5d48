"""Structs and constants that Python reads from headers, against what a compiler reads."""

import ctypes
import re
import subprocess

import check_kernels
import pytest

from megastep.kernels.build import compile, kernel_library
from megastep.kernels.build.launch import ENGINE
from megastep.web import program

LIBRARIES = {"/".join(one.folder.parts[-3:]): one for one in check_kernels.libraries()}
libraries = pytest.mark.parametrize("library", LIBRARIES.values(), ids=LIBRARIES)


def compiled(folder, library, code):
    """A library of `code`, which sees the library's headers."""
    source, binary = folder / "checks.cpp", folder / "checks.so"
    source.write_text(code)
    command = [compile.compiler()[0], "-std=c++17", "-shared", "-fPIC"]
    command += [f"-I{library.folder}", f"-I{compile.KERNELS}", str(source), "-o", str(binary)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(binary))


def is_number(kind):
    return not issubclass(kind, (ctypes.Array, ctypes.Structure))


@libraries
def test_packed_structs_have_the_compilers_layout(library, tmp_path):
    """A compiler reads every field of every packed struct with the value that was packed."""
    names = [*filter(lambda name: "/" not in name, library.sources(".h"))]
    declaring = [
        name for name in names if kernel_library.STRUCT.search(library.sources(".h")[name])
    ]
    packed, code = {}, '#include "common/objects.h"\n#include "common/step.h"\n'
    code += "".join(f'#include "{name}"\n' for name in declaring)
    for name, layout in library.structs.items():
        fields = dict(layout._all_fields_)
        values: dict = {field: position + 1 for position, field in enumerate(fields)}
        whole = {f: bytes(ctypes.sizeof(kind)) for f, kind in fields.items() if not is_number(kind)}
        packed[name] = getattr(library.params, name)(**values | whole)
        tests = [f"(long long)p->{f} == {values[f]}" for f in fields.keys() - whole.keys()]
        tests.append(f"size == sizeof({name})")
        code += (
            f'extern "C" int check_{name}(const {name}* p, int size) '
            f"{{ return {' && '.join(tests)}; }}\n"
        )
    checks = compiled(tmp_path, library, code)
    for name, data in packed.items():
        assert getattr(checks, f"check_{name}")(data, len(data)), name


NESTED = """
struct NumbersParams {
    int count;
    float size;
    unsigned int mask;
};
struct PointerParams {
    int count;
    const float* values;
    float size;
};
struct ArraysParams {
    int first;
    NumbersParams numbers[3];
    int second;
    PointerParams pointers[2];
    int third;
};
struct OneParams {
    int first;
    NumbersParams one;
};
struct MoreParams : PointerParams {
    int more;
    const int* others;
};
"""


def structs_of(folder, text):
    (folder / "params.h").write_text(text)
    return kernel_library.KernelLibrary(folder).structs


def test_arrays_of_structs_have_the_compilers_layout(tmp_path):
    """Structs without a pointer have other sizes and places than those with one."""
    structs = structs_of(tmp_path, NESTED)
    pack = {name: kernel_library.packer(layout) for name, layout in structs.items()}
    numbers = [dict(count=i, size=i + 0.5, mask=2**31 + i) for i in range(2)]
    pointers = [dict(count=5 + i, values=2**40 + i, size=-i) for i in range(2)]
    numbers = [pack["NumbersParams"](**fields) for fields in numbers]
    pointers = [pack["PointerParams"](**fields) for fields in pointers]
    arrays = dict(numbers=b"".join(numbers), pointers=b"".join(pointers))
    packed = dict(
        ArraysParams=pack["ArraysParams"](first=-1, second=-2, third=-3, **arrays),
        OneParams=pack["OneParams"](first=-1, one=numbers[1]),
        MoreParams=pack["MoreParams"](more=7, others=8, count=9, values=10, size=0.5),
    )
    code = (
        NESTED
        + """
    extern "C" int check_ArraysParams(const ArraysParams* p, int size) {
        int fits = size == sizeof(*p) && p->first == -1 && p->second == -2 && p->third == -3;
        for (int i = 0; i < 2; i++) {
            fits &= p->numbers[i].count == i && p->numbers[i].size == i + 0.5f;
            fits &= p->numbers[i].mask == (1u << 31) + i && p->pointers[i].size == -i;
            fits &= p->pointers[i].count == 5 + i;
            fits &= (long long)p->pointers[i].values == (1ll << 40) + i;
        }
        return fits && !p->numbers[2].count && !p->numbers[2].size && !p->numbers[2].mask;
    }
    extern "C" int check_OneParams(const OneParams* p, int size) {
        return size == sizeof(*p) && p->first == -1 && p->one.count == 1 && p->one.size == 1.5f;
    }
    extern "C" int check_MoreParams(const MoreParams* p, int size) {
        return size == sizeof(*p) && p->more == 7 && (long long)p->others == 8 && p->count == 9 &&
               (long long)p->values == 10 && p->size == 0.5f;
    }
    """
    )
    checks = compiled(tmp_path, ENGINE, code)
    for name, data in packed.items():
        assert getattr(checks, f"check_{name}")(data, len(data)), name


def test_words_are_the_scalars_of_nested_structs_in_order(tmp_path):
    structs = structs_of(tmp_path, NESTED)
    words = {name: [*program._words(layout)] for name, layout in structs.items()}
    assert words["OneParams"] == [
        ("first", "i", 0),
        *(("one.count", "i", 4), ("one.size", "f", 8), ("one.mask", "I", 12)),
    ]
    arrays = {word.name: word for word in words["ArraysParams"]}
    first = "first numbers.0.count numbers.0.size numbers.0.mask numbers.1.count"
    assert [*arrays][:5] == first.split()
    assert arrays["numbers.2.mask"].offset == 36 and arrays["second"].offset == 40
    assert arrays["pointers.1.values"] == ("pointers.1.values", "P", 48 + 24 + 8)
    assert arrays["third"].offset == 48 + 2 * 24 and len(arrays) == 3 + 3 * 3 + 2 * 3


def test_constants_are_those_of_headers_that_are_plain_numbers(tmp_path):
    (tmp_path / "numbers.h").write_text(
        "constexpr int COUNT = -12;  // of\n"
        "// constexpr int OLD = 1;\nconstexpr float HALF = .5f;\n"
        "constexpr float SMALL = -2.5e-3f;\nconstexpr int MASK = 0x7f;\n"
        "constexpr int TWICE = 2 * COUNT;\n"
    )
    constants = kernel_library.KernelLibrary(tmp_path).constants
    own = {name: number for name, number in constants.items() if name not in ENGINE.constants}
    assert own == dict(COUNT=-12, HALF=0.5, SMALL=-0.0025)
    assert constants["BLOCK"] == 64 and constants["WARP"] == 32


@pytest.mark.parametrize("field", ["double x;", "float x, y;", "OtherParams other;", "int x[3];"])
def test_a_field_that_cannot_be_packed_is_named(field, tmp_path):
    with pytest.raises(ValueError, match="params.h: .*" + re.escape(field[:-1])):
        structs_of(tmp_path, f"struct AParams {{\n    int a;\n    {field}\n}};\n")


def test_a_field_that_is_missing_or_unknown_is_named():
    fields = dict(counts=0, mask=0, out=0, key0=1, key1=2, n_lanes=0, n_threads=1)
    pack = ENGINE.params.UniformParams
    pack(**fields)
    with pytest.raises(TypeError, match="UniformParams has no field 'n_lane'"):
        pack(**fields, n_lane=3)
    del fields["key1"]
    for others in ({}, dict(n_lane=3)):
        with pytest.raises(TypeError, match="UniformParams needs the field 'key1'"):
            pack(**fields, **others)
