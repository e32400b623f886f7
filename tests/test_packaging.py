"""Installation by a user: the wheel built from the sdist holds everything, works, and adds only `unifg`."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pytest

from scripts import CHECKOUT, files_in_git

SIDES = ("solvers", "models", "scenarios")
# Only the extra `scenarios` installs these; the language, the backends and the models must do without.
EXTRAS = ("matplotlib", "meshcat", "pandas", "PIL", "pymunk", "tqdm", "yaml")


def config() -> dict[str, Any]:
    """Read pyproject.toml."""
    return tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command, show what it said if it fails, and return its output."""
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=clean, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_listed_packages_are_those_in_the_tree() -> None:
    found = set()
    for top, folder in [
        ("unifg", CHECKOUT / "unifg"),
        *[(f"unifg.{side}", CHECKOUT / side) for side in SIDES],
    ]:
        for directory, names, files in os.walk(folder):  # does not follow the links
            names[:] = [name for name in names if name != "__pycache__"]
            if any(file.endswith(".py") for file in files):
                found.add(".".join([top, *Path(directory).relative_to(folder).parts]))
    assert found == set(config()["tool"]["setuptools"]["packages"])


def test_every_package_has_an_init() -> None:
    setuptools = config()["tool"]["setuptools"]
    for package in setuptools["packages"]:
        folder = setuptools["package-dir"].get(package, package.replace(".", "/"))
        assert (CHECKOUT / folder / "__init__.py").is_file(), package


@pytest.mark.parametrize("side", SIDES)
def test_links_point_at_the_side_folders(side: str) -> None:
    link = CHECKOUT / "unifg" / side
    if not link.is_symlink():
        pytest.skip("this checkout has no symbolic links (Windows without developer mode, some archives)")
    assert link.readlink() == Path("..") / side


def test_one_version() -> None:
    stated = config()["project"]["version"]
    changelog = (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## \[(\d[^\]]*)\]", changelog, flags=re.MULTILINE)
    assert newest is not None
    assert newest[1] == stated
    try:
        installed = version("unifg")
    except PackageNotFoundError:
        pytest.skip("unifg is not installed here: run make test")
    assert installed == stated, "pyproject.toml is newer than the installation: run make test"


def copy_checkout(origin: Path, target: Path) -> Path:
    """Copy what a clone would hold."""
    ignored = shutil.ignore_patterns(".*", "*.egg-info", "__pycache__", "build", "dist", "out")
    shutil.copytree(origin, target, symlinks=True, ignore=ignored)
    if not (target / "README.md").exists():  # pyproject.toml names it
        (target / "README.md").write_text("# unifg\n", encoding="utf-8")
    return target


def build_wheel(source: Path) -> Path:
    """Build an sdist, and from it a wheel; without network where setuptools is new enough."""
    required = re.search(r"\d+", config()["build-system"]["requires"][0])
    assert required is not None
    try:
        recent = int(version("setuptools").split(".")[0]) >= int(required[0])
    except PackageNotFoundError:
        recent = False
    run(sys.executable, "-m", "build", *(["--no-isolation"] if recent else []), source, cwd=source)
    (wheel,) = (source / "dist").glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of this checkout to build in: building writes into the source tree."""
    return copy_checkout(CHECKOUT, tmp_path_factory.mktemp("wheel") / "unifg")


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    """The wheel of this checkout."""
    return build_wheel(source)


@pytest.fixture(scope="module")
def clean(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment that holds only the wheel; its dependencies are read from the one of the tests."""
    home = tmp_path_factory.mktemp("clean")
    venv.create(home / "env", with_pip=False, symlinks=os.name != "nt")
    scripts = home / "env" / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / ("python.exe" if os.name == "nt" else "python")
    run(sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python,
        "install", "--quiet", "--no-compile", "--no-deps", "--no-index", wheel, cwd=home)  # fmt: skip
    # A folder named in a .pth file is searched last; .pth files in it (an editable unifg) are not read.
    own = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=home).strip()
    theirs = dict.fromkeys(sysconfig.get_path(kind) for kind in ("purelib", "platlib"))
    (Path(own) / "dependencies.pth").write_text("\n".join(theirs) + "\n", encoding="utf-8")
    return scripts


@pytest.mark.product(1, of="wheels")
def test_wheel_holds_the_packages_and_nothing_else(source: Path, wheel: Path) -> None:
    assert wheel.name == f"unifg-{config()['project']['version']}-py3-none-any.whl"
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {
        "unifg",
        f"unifg-{config()['project']['version']}.dist-info",
    }
    outer = [path.parent for side in SIDES for path in (source / side).rglob("__init__.py")]
    folders = {f"unifg/{folder.relative_to(source).as_posix()}": folder for folder in outer}
    inner = [path.parent for path in (source / "unifg").rglob("__init__.py")]
    folders |= {folder.relative_to(source).as_posix(): folder for folder in inner if folder.name not in SIDES}
    expected = {f"{name}/{path.name}" for name, folder in folders.items() for path in folder.glob("*.py")}
    maps = [path for kind in ("*.pgm", "*.yaml") for path in (source / "scenarios" / "simulation").glob(kind)]
    assert {path.suffix for path in maps} == {".pgm", ".yaml"}, "no map is shipped"
    expected |= {f"unifg/scenarios/simulation/{path.name}" for path in maps}
    papers = [path for path in (source / "scenarios" / "papers").iterdir() if path.suffix in (".png", ".toml", ".yaml")]
    assert {path.name for path in papers} >= {"papers.toml", "department.png", "factory.yaml"}
    expected |= {f"unifg/scenarios/papers/{path.name}" for path in papers}
    expected |= {
        "unifg/py.typed",
        "unifg/view/live.js",
        "unifg/view/page.html",
        "unifg/scenarios/commands/performance.jsonl",
        "unifg/scenarios/logs/foxglove.json",
    }
    if (source / "unifg" / "codegen" / "kernels.zip").exists():  # what may be missing is compiled on the first use
        expected.add("unifg/codegen/kernels.zip")
    assert {name for name in names if ".dist-info/" not in name} == expected


@pytest.mark.product(1, of="wheels")
@pytest.mark.parametrize("folder", ["examples", "tests"])
def test_sdist_holds_examples_and_tests(source: Path, wheel: Path, folder: str) -> None:
    del wheel  # building it leaves the sdist beside it
    (sdist,) = (source / "dist").glob("*.tar.gz")
    names = {Path(*Path(name).parts[1:]) for name in tarfile.open(sdist).getnames()}
    tracked = {path.relative_to(CHECKOUT) for path in files_in_git() if path.is_relative_to(CHECKOUT / folder)}
    assert tracked <= names


@pytest.mark.product(1, of="wheels")
def test_wheel_is_the_same_without_links(source: Path, wheel: Path, tmp_path: Path) -> None:
    """Git on Windows, and some archives, turn a link into a small text file that holds its target."""
    bare = copy_checkout(source, tmp_path / "unifg")
    for side in SIDES:
        (bare / "unifg" / side).unlink(missing_ok=True)
        (bare / "unifg" / side).write_text(f"../{side}", encoding="utf-8")
    first, second = zipfile.ZipFile(wheel), zipfile.ZipFile(build_wheel(bare))
    assert sorted(first.namelist()) == sorted(second.namelist())
    assert [n for n in first.namelist() if first.read(n) != second.read(n)] == []


@pytest.mark.product(1, of="wheels")
def test_imports_come_from_the_wheel(clean: Path) -> None:
    # Deliberately started in the checkout: -I keeps the working directory off the path.
    out = run(
        clean / "python", "-I", "-W", "error", "-c",
        "import sys\n"
        f"for name in {EXTRAS}: sys.modules[name] = None\n"  # makes importing them fail
        "import unifg, unifg.files, unifg.lie, unifg.solvers, unifg.models\n"
        "from importlib.metadata import version\n"
        "from importlib.resources import files\n"
        "assert files('unifg').joinpath('py.typed').is_file()\n"
        "assert unifg.__version__ == version('unifg')\n"
        "for m in (unifg, unifg.files, unifg.lie, unifg.solvers, unifg.models): print(m.__file__)\n",
        cwd=CHECKOUT,
    )  # fmt: skip
    home = clean.parent.resolve()
    for file in out.splitlines():
        assert Path(file).resolve().is_relative_to(home), file


@pytest.mark.product(1, of="wheels")
def test_bare_side_folders_are_not_installed(clean: Path) -> None:
    out = run(
        clean / "python", "-I", "-c",
        f"from importlib.util import find_spec; print([n for n in {SIDES} if find_spec(n)])", cwd=clean,
    )  # fmt: skip
    assert out.strip() == "[]"


@pytest.mark.product(1, of="wheels")
def test_the_shipped_map_can_be_loaded(clean: Path) -> None:
    pytest.importorskip("yaml")
    out = run(
        clean / "python", "-I", "-c",
        "from importlib.resources import as_file, files\n"
        "from unifg.files.ros_map import load_map\n"
        "for entry in files('unifg.scenarios.simulation').iterdir():\n"
        "    if entry.name.endswith('.yaml'):\n"
        "        with as_file(entry) as path: print(load_map(path).shape)\n",
        cwd=clean,
    )  # fmt: skip
    assert out.strip() != ""


@pytest.mark.product(1, of="wheels")
def test_console_script(clean: Path) -> None:
    for extra in EXTRAS:
        pytest.importorskip(extra)
    assert config()["project"]["version"] in run(clean / "unifg", "--version", cwd=clean)


@pytest.mark.product(1, of="wheels")
def test_a_table_of_a_paper_from_the_wheel(clean: Path, tmp_path: Path) -> None:
    for extra in EXTRAS:
        pytest.importorskip(extra)
    out = run(  # in one process, which imports everything once
        clean / "python", "-I", "-c",
        "from unifg.scenarios.command import main\n"
        "from unifg.scenarios.papers import bazzana\n"
        "assert main(['reproduce', 'ecg2o', '--table', '1']) == main(['reproduce']) == 0\n"
        "print(*(len(bazzana.campaign(name)) for name in bazzana.ROMAN))",
        cwd=tmp_path,
    )  # fmt: skip
    assert "| iterations, KKT, steps below 1e-3 | 5 | 7.33 | +2.33 |" in out
    assert "--table III" in out and not list(tmp_path.iterdir())
    assert out.split()[-2:] == ["480", "240"], "the campaigns and their maps"


@pytest.mark.parametrize("installed", [False, True], ids=["not installed", "installed"])
@pytest.mark.parametrize("links", ["text files", "missing"])
@pytest.mark.product(2, of="processes of their own")
def test_a_checkout_without_links_finds_its_side_folders(links: str, installed: bool, tmp_path: Path) -> None:
    """Imports from a checkout work even where Git or an archive makes no symbolic links."""
    ignored = shutil.ignore_patterns("__pycache__", *SIDES)
    checkout = tmp_path / "checkout"
    shutil.copytree(CHECKOUT / "unifg", checkout / "unifg", ignore=ignored)
    for side in SIDES:
        shutil.copytree(CHECKOUT / side, checkout / side, ignore=shutil.ignore_patterns("__pycache__"))
        if links == "text files":
            (checkout / "unifg" / side).write_text(f"../{side}", encoding="utf-8")
    paths = [sysconfig.get_paths()["purelib"], sysconfig.get_paths()["platlib"]]
    if installed:  # as a wheel lies in an environment
        shutil.copytree(checkout / "unifg", tmp_path / "environment" / "unifg", ignore=ignored)
        for side in SIDES:
            (tmp_path / "environment" / "unifg" / side).unlink(missing_ok=True)
            shutil.copytree(checkout / side, tmp_path / "environment" / "unifg" / side)
        paths.insert(0, str(tmp_path / "environment"))
    asked = "import unifg, unifg.solvers.names, unifg.models, unifg.scenarios; "
    asked += "print(*[m.__file__ for m in (unifg, unifg.solvers, unifg.models, unifg.scenarios)], sep='\\n')"
    environment = {"PYTHONPATH": os.pathsep.join(paths), "PATH": os.environ.get("PATH", "")}
    for cwd, home in [(checkout, checkout)] + ([(tmp_path, tmp_path / "environment" / "unifg")] if installed else []):
        done = subprocess.run(  # -S: site would find an editable installation of this checkout
            [sys.executable, "-S", "-c", asked], cwd=cwd, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert all(Path(line).is_relative_to(home) for line in done.stdout.splitlines()), done.stdout
