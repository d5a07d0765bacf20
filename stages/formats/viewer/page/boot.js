// Runs before any module: unpacks the libraries, tells modules where each other is, and says in words what is missing.
(async () => {
  const text = (id) => document.getElementById(id).textContent;
  const say = (sentence) => {
    document.getElementById("message").textContent = sentence;
    document.body.classList.add("stuck");
  };
  const missing = () => {
    const wanted = { alpha: true, antialias: false, powerPreference: "high-performance" }; // as three.js asks again
    if (!document.getElementById("canvas").getContext("webgl2", wanted)) return "WebGL2, which draws the person. Graphics acceleration may be switched off";
    if (!window.DecompressionStream) return "DecompressionStream, which unpacks this file";
    if (!HTMLScriptElement.supports?.("importmap")) return "import maps, by which the parts of this file find each other";
    return "";
  };
  const gunzip = async (base64) => {
    const packed = await fetch(`data:application/gzip;base64,${base64}`);
    return new Response(packed.body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  };
  try {
    const lacks = missing();
    if (lacks) return say(`This browser lacks ${lacks}. A current Chrome, Edge, Firefox or Safari opens the page.`);
    const imports = {};
    const add = (name, source) => {
      imports[name] = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    };
    const libraries = JSON.parse(text("libraries"));
    await Promise.all(Object.entries(libraries).map(async ([name, packed]) => {
      const source = new TextDecoder().decode(await gunzip(packed));
      add(name, source.replaceAll("'./three.core.js'", "'three-core'")); // a blob is no folder to look beside
    }));
    Object.entries(JSON.parse(text("modules"))).forEach(([name, source]) => add(name, source));
    const map = document.createElement("script");
    map.type = "importmap";
    map.textContent = JSON.stringify({ imports });
    document.head.append(map);
    const facts = JSON.parse(text("facts"));
    const { start } = await import("hugs/main");
    await start(facts, await gunzip(text("data")));
    document.body.classList.add("open");
  } catch (error) {
    console.error(error);
    say(`The page could not open: ${error.message}`);
  }
})();
