"""What pyproject.toml cannot say: the nets of prototxt/ travel in the wheel; the README has whole addresses there."""

import ast
import re
import runpy
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

HERE = Path(__file__).parent
NETS = HERE / "prototxt"
SHIPPED = HERE / "netspec" / "inspect" / "features" / "shipped.py"


def files():
    """Return the files that travel: all prototxts, and of nets that have a name weights, source and license."""
    tree = ast.parse(SHIPPED.read_text(encoding="utf-8"))
    named = {ast.literal_eval(part.value) for part in tree.body if isinstance(part, ast.Assign)}
    found = sorted(NETS.rglob("*.prototxt"))
    for net in sorted(named):
        folder = NETS / net
        # SOURCE.md, SOURCES.csv and LICENSE
        found += [folder / f"{folder.name}.caffemodel", *sorted(folder.glob("[A-Z]*"))]
    return [path.relative_to(NETS) for path in found]


class BuildPy(build_py):
    """An editable installation reads prototxt/ where it is."""

    def run(self):
        """Build the packages, and copy the nets beside them, with their variants."""
        runpy.run_path(str(NETS / "variants.py"), run_name="__main__")
        super().run()
        if not getattr(self, "editable_mode", False):
            for path in files():
                target = Path(self.build_lib) / "netspec" / "prototxt" / path
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(NETS / path, target)


def readme():
    """Return README.md for a package index: each link to a file of the project is a whole address."""
    source = re.search(r'^Source = "(.+?)"', (HERE / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)[1]

    def whole(link):
        kind = "raw" if link[1].startswith("!") else "blob"
        return f"{link[1]}({source}/{kind}/main/{link[2]})"

    return re.sub(r"(!?\[[^\]]*\])\((?!\w+://|#)([^)]*)\)", whole, (HERE / "README.md").read_text(encoding="utf-8"))


setup(cmdclass={"build_py": BuildPy}, long_description=readme(), long_description_content_type="text/markdown")
