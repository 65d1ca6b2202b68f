// Python in a worker. run.js starts the worker from the text of this function, because browsers refuse workers by
// address on pages from the disk.
"use strict";

// eslint-disable-next-line no-unused-vars
function zwfsWorker() {
  let python, driver;
  let needed = true; // whether Python cannot do without the files that are loaded now

  // Every file is checked by the browser while it is fetched: the core against our list, packages against the lock
  // of Pyodide, which is on our list. Nothing without a digest is fetched.
  function fetchChecked(digests, refuse) {
    const fetchAny = self.fetch;
    self.fetch = async (address, options = {}) => {
      const url = String(address.url ?? address);
      const name = url.split("/").pop();
      const integrity = digests[name] ?? options.integrity;
      if (!integrity) throw new Error(`${name}: no digest is known`);
      let problem = "it cannot be reached, or is not the file that this book expects";
      try {
        const response = await fetchAny(url, { integrity, credentials: "omit" });
        if (response.ok) return response;
        problem = `status ${response.status}`;
      } catch {
        // The browser does not say which of the two it was.
      }
      const error = new Error(`Python was not loaded: ${name}: ${problem}`);
      if (needed) refuse(error); // Pyodide waits for some files for ever
      throw error;
    };
  }

  const load = (given) =>
    new Promise((done, refuse) => {
      fetchChecked(given.digests, refuse);
      start(given).then(done, refuse);
    });

  // Start Pyodide with its packages and the files of this book.
  async function start({ place, packages, extra, files }) {
    for (const name of ["pyodide.js", "pyodide.asm.js"]) {
      const script = URL.createObjectURL(await (await fetch(place + name)).blob());
      importScripts(script);
      URL.revokeObjectURL(script);
    }
    let failed = "";
    python = await loadPyodide({ indexURL: place, stdout: () => {}, stderr: () => {} });
    await python.loadPackage(packages, { messageCallback: () => {}, errorCallback: (text) => (failed = text) });
    if (packages.some((name) => !(name in python.loadedPackages))) throw new Error(failed);
    needed = false; // a notebook says itself what it misses of these
    await python.loadPackage(extra, { messageCallback: () => {}, errorCallback: () => {} });
    const bytes = Uint8Array.from(atob(files), (letter) => letter.charCodeAt(0));
    python.unpackArchive(bytes, "zip", { extractDir: python.runPython("import site; site.getsitepackages()[0]") });
    driver = python.pyimport("driver");
    driver.prepare((name, done, total) => postMessage({ progress: { name, done, total } }));
    return JSON.parse(driver.versions());
  }

  const calls = {
    load,
    begin: ({ notebook, defaults, given }) => driver.begin(notebook, defaults, given),
    cell: ({ source }) => JSON.parse(driver.cell(source)),
    example: ({ source }) => JSON.parse(driver.example(source)),
    kinds: ({ figure }) => driver.kinds(figure).toJs(),
    draw: ({ figure, kind }) => driver.draw(figure, kind).toJs(),
    put: ({ name, bytes }) => python.FS.writeFile(name, new Uint8Array(bytes)),
  };

  self.onmessage = async ({ data: { id, call, given } }) => {
    try {
      postMessage({ id, value: await calls[call](given) });
    } catch (error) {
      const lines = String(error.message ?? error).trim().split("\n");
      const said = lines.findLast((line) => /^[\w.]+: /.test(line)) ?? lines[lines.length - 1];
      postMessage({ id, error: said }); // of a traceback, the error itself
    }
  };
}
