"""Wheel and sdist: what is in them, and that they work where nothing else of the project is."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import reframe_jax

ROOT = Path(__file__).parent.parent


def run(*command: str | Path, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with an sdist, and the wheel made from it alone."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", out, cwd=ROOT)
    (sdist,) = out.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(out, filter="data")
    source = out / sdist.name.removesuffix(".tar.gz")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", out, cwd=source)
    return out


def test_the_version_comes_from_one_place(built: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert (built / f"reframe_jax-{reframe_jax.__version__}.tar.gz").exists()
    assert (built / f"reframe_jax-{reframe_jax.__version__}-py3-none-any.whl").exists()
    assert f"## {reframe_jax.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_start_page_names_every_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    page = (ROOT / "docs" / "index.md").read_text()
    (line,) = re.findall(r"^Extras of .*?\n\n", page, re.MULTILINE | re.DOTALL)
    missing = [name for name in project["optional-dependencies"] if f"`{name}`" not in line]
    assert not missing


def test_every_requirement_has_an_upper_bound() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    names = [name for group in groups for name in group if not name.startswith("reframe-jax[")]
    assert [name for name in names if "<" not in name] == []


def test_every_installed_package_is_pinned_with_hashes() -> None:
    lines = (ROOT / "requirements.txt").read_text().replace("\\\n", " ").splitlines()
    pinned = [line for line in lines if line and not line.startswith("#")]
    for line in pinned:
        assert re.fullmatch(r"[\w.-]+==[\w.]+( ; [^-]+)?( +--hash=sha256:[0-9a-f]{64})+", line), line
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted, known = [*project["dependencies"], *extras["test"], *extras["docs"]], set()
    while wanted:
        requirement = wanted.pop()
        if requirement.startswith("reframe-jax["):
            wanted += [name for extra in requirement[12:-1].split(",") for name in extras[extra]]
        else:
            known.add(re.match(r"[\w.-]+", requirement)[0].lower())
    assert known <= {line.split("==")[0] for line in pinned}
    assert "://" not in "".join(lines)


def test_the_wheel_holds_the_package_and_nothing_else(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (name for name in names if name.endswith("METADATA"))
        text = archive.read(metadata).decode()
    tops = {name.split("/")[0] for name in names}
    assert tops == {"reframe_jax", f"reframe_jax-{reframe_jax.__version__}.dist-info"}
    assert "reframe_jax/py.typed" in names
    files = [path for path in (ROOT / "reframe_jax").rglob("*.*") if path.suffix in (".py", ".xml", ".css")]
    assert {str(path.relative_to(ROOT)) for path in files} <= set(names)
    extras = set(re.findall(r"^Provides-Extra: (\S+)$", text, re.MULTILINE))
    assert {
        "plot",
        "parquet",
        "pandas",
        "viewer",
        "distributed",
        "benchmark",
        "notebooks",
        "docs",
        "cuda",
        "render",
        "bags",
        "c3d",
        "hdf5",
        "test",
    } <= extras


def test_the_sdist_holds_what_is_needed_to_work_on_it(built: Path) -> None:
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    expected = {"tests/conftest.py", "benchmarks/paper.py", "docs/conf.py", "Makefile", "LICENSE"}
    assert expected <= names
    assert not any(name.startswith(("docs/_build", "out/", ".")) for name in names - {".gitignore"})


def check(python: Path, cwd: Path) -> None:
    """The installed package, its command and its data, away from the checkout."""
    where = run(python, "-c", "import reframe_jax; print(reframe_jax.__file__)", cwd=cwd)
    assert Path(where.strip()).is_relative_to(python.parent.parent)
    version = f"reframe-jax {reframe_jax.__version__}"
    assert run(python, "-m", "reframe_jax", "--version", cwd=cwd).strip() == version
    assert "Pin-plane contact" in run(python.parent / "reframe-jax", "constraints", cwd=cwd)


def test_the_wheel_works_by_itself(built: Path, tmp_path: Path) -> None:
    """Installed alone; its dependencies are those of this environment."""
    (wheel,) = built.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    site = Path(run(python, "-c", "import site; print(site.getsitepackages()[0])", cwd=tmp_path).strip())
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "-q")
    run(*pip, wheel, cwd=tmp_path)
    # after the new environment's own packages; an editable install there would be found by its hook
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    check(python, tmp_path)


@pytest.mark.slow
def test_wheel_and_sdist_install_into_an_empty_environment(built: Path, tmp_path: Path) -> None:
    """What the project names is installed, at the pinned versions; a requirement that it forgot is not."""
    pinned = re.findall(r"^[\w.-]+==[^\\\n]*", (ROOT / "requirements.txt").read_text(), re.MULTILINE)
    constraints = tmp_path / "constraints.txt"
    constraints.write_text("\n".join(pinned))
    for number, archive in enumerate((*built.glob("*.whl"), *built.glob("*.tar.gz"))):
        home = tmp_path / str(number)
        venv.create(home, with_pip=True)
        python = home / "bin" / "python"
        install = (python, "-m", "pip", "install", "-q")
        run(*install, "--constraint", constraints, archive, cwd=tmp_path)
        run(python, "-m", "pip", "check", cwd=tmp_path)
        check(python, tmp_path)
        done = run(
            python, "-m", "reframe_jax", "identify", ROOT / "examples" / "pin_on_plane.csv", cwd=tmp_path
        )
        assert "Pin-plane contact" in done
