"""Times of the pages of the book in a browser: ZWFS_PYODIDE=FOLDER python -m tests.benchmarks.pages [NAME ...]

It opens each page of a notebook in the built book and runs its quick values, or its defaults where it has none, up
to the first figure. The times go to book/_ext/performance.json. Run no other programs at the same time.
"""

import json
import sys
from time import perf_counter

from playwright.sync_api import sync_playwright

from zwfs._system import write_file

from ..conftest import find_chromium
from ..test_run_in_page import HTML, Page, serving, settings
from .report import KEPT, fingerprint, rounded

STATUS = "document.querySelector('.run-details [role=status]')"


def measure(browser, book, name):
    """Return the seconds until Python is ready, and from then on until the figure is seen."""
    page = Page(browser, f"{book}notebooks/{name}.html")
    page.open()
    if settings(name)["quick"]:
        page.page.get_by_role("button", name="Quick values").click()
    began = perf_counter()
    page.page.click(".run-details button[type=submit]")
    page.page.wait_for_function(f"!/^(The|Load)/.test({STATUS}.textContent)")
    ready = perf_counter()
    page.page.wait_for_function("document.querySelector('.run-details progress').hidden", timeout=600_000)
    done = perf_counter()
    said = page.status.inner_text()
    page.context.close()
    if not said.startswith("Done"):
        print(f"{name}: {said}")
        return None
    return {"page": name, "quick": bool(settings(name)["quick"]), "python": ready - began, "figure": done - ready}


def main(names):
    known = sorted(file.stem for file in (HTML / "notebooks").glob("*.html"))
    kept = json.loads(KEPT.read_text("utf-8"))
    rows = {row["page"]: row for row in kept.get("pages", [])}
    with sync_playwright() as driver, serving(HTML) as book:
        browser = driver.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        for name in names or known:
            if row := measure(browser, book, name):
                rows[name] = rounded(row)
                print(f"{name:28}{row['python']:7.1f} s{row['figure']:7.1f} s", flush=True)
                kept["pages"] = [rows[one] for one in sorted(rows)]
                kept["sha256"] = fingerprint(kept)
                write_file(KEPT, (json.dumps(kept, indent=1, ensure_ascii=False) + "\n").encode())


if __name__ == "__main__":
    main(sys.argv[1:])
