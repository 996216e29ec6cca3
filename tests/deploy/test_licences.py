"""No licence comes in that puts conditions on this project's own code, and docs/licences.md tells the truth."""

from __future__ import annotations

import pytest

from benchmarks.licences import GPL_LIBRARIES, PAGE, Package, runtime_packages


def test_runtime_packages_are_welcome() -> None:
    packages = runtime_packages()
    assert len(packages) > 40
    assert [package for package in packages if not package.welcome] == []
    assert {package.name for package in packages} >= {"torch", "av", "ray", "psycopg-binary", "starlette"}
    assert {package.name for package in packages}.isdisjoint({"evo", "plyfile"}), "GPL: for development only"


def test_native_libraries_under_the_gpl_are_those_that_are_named() -> None:
    found = {(package.name, library) for package in runtime_packages() for library in package.gpl_libraries}
    assert found <= {("av", library) for library in GPL_LIBRARIES}


def test_the_page_is_current() -> None:
    text = PAGE.read_text()
    for package in runtime_packages():
        assert f"| {package.name} | {package.licence} |" in text, "run python -m benchmarks.licences"


@pytest.mark.parametrize(
    "licence",
    [
        "GNU General Public License v3 (GPLv3)",
        "GPL-2.0-or-later",
        "AGPL-3.0-only",
        "Proprietary",
        "unknown",
        "SSPL-1.0",
    ],
)
def test_licences_that_stay_out(licence: str) -> None:
    assert not Package("x", licence, ()).welcome


@pytest.mark.parametrize("licence", ["MIT", "LGPL-3.0-only", "Apache-2.0 OR BSD-3-Clause", "MPL-2.0"])
def test_licences_that_may_come_in(licence: str) -> None:
    assert Package("x", licence, ()).welcome
