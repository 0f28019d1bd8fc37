(() => {
  document.title = "vibrissa";
  // The server shows what a link asks for; viser would take it for a part of the address.
  if (location.hash) {
    fetch("restore?" + location.hash.slice(1));
    history.replaceState(null, "", location.pathname + location.search);
  }
  // The page is dark as long as the browser is.
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const matched = () => {
    const asked = new URLSearchParams(location.search);
    if (dark.matches) asked.set("darkMode", ""); else asked.delete("darkMode");
    history.replaceState(null, "", "?" + asked + location.hash);
  };
  if (dark.matches) matched();
  dark.addEventListener("change", () => { matched(); location.reload(); });

  // Keys press buttons; the mouse in a plot over time sets the time.
  const button = (...texts) => [...document.querySelectorAll("button")].find(
    (each) => each.offsetParent && texts.includes(each.textContent.trim()));
  let wanted = null, asking = false;
  const setTime = async (share) => {
    wanted = share;
    if (asking) return;  // requests could overtake each other
    asking = true;
    while (wanted !== null) {
      const asked = wanted;
      wanted = null;
      await fetch("restore?t=" + asked).catch(() => {});
    }
    asking = false;
  };
  const keys = {
    ",": ["◀ frame"], ".": ["frame ▶"], "p": ["◀ contact"], "n": ["contact ▶"],
    "a": ["All"], " ": ["Play", "Pause"],
  };
  const ends = { "Home": 0, "End": 1 };
  addEventListener("keydown", (event) => {
    // The space bar presses the button that was clicked last.
    const typing = (event.key === " " ? /^(INPUT|TEXTAREA|BUTTON)$/ : /^(INPUT|TEXTAREA)$/)
      .test(event.target.tagName);
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in ends && document.querySelector("svg[data-timeline]")) {
      event.preventDefault();
      setTime(ends[event.key]);
    }
    const found = keys[event.key] && button(...keys[event.key]);
    if (found) { event.preventDefault(); found.click(); }
  });
  // A plot is drawn anew as its time changes: what counts is where it was.
  let held = null, moved = 0;
  const seek = (event) => {
    const share = ((event.clientX - held.x) / (held.width - 8) - held.left) / (1 - held.left);
    if (share >= 0 || event.type === "pointermove") setTime(Math.min(Math.max(share, 0), 1));
  };
  addEventListener("pointerdown", (event) => {
    const plot = event.target.closest?.("svg[data-seek]");
    if (!plot) return;
    const { x, width } = plot.getBoundingClientRect();
    held = { x, width, left: Number(plot.dataset.seek) };
    seek(event);
  });
  addEventListener("pointermove", (event) => {
    if (!held || event.timeStamp < moved + 50) return;
    moved = event.timeStamp;
    seek(event);
  });
  for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { held = null; });

  // The address keeps what is seen, so that a link leads back to it. What is drawn counts as
  // narrow where the server's `framed` centres it above the panel.
  setInterval(() => {
    const drawn = document.querySelector("canvas"), page = document.documentElement;
    if (drawn) {
      const narrow = drawn.clientWidth < 0.65 * drawn.clientHeight;
      page.classList.toggle("narrow", narrow);
      page.classList.toggle("tight", !narrow && drawn.clientWidth < 960);
      page.style.setProperty("--drawn", `${drawn.clientWidth}px`);
    }
    const strip = document.querySelector("svg[data-timeline]");
    if (strip) page.style.setProperty("--fine", 300 / strip.getBoundingClientRect().width);
    const state = document.querySelector("[data-link]")?.dataset.link;
    if (state && location.hash !== "#" + state)
      history.replaceState(null, "", location.search + "#" + state);
  }, 500);

  // Arrow keys that move a slider are not for the view as well.
  addEventListener("DOMContentLoaded", () => document.body.addEventListener("keydown", (event) => {
    if (event.target.getAttribute?.("role") === "slider") event.stopPropagation();
  }));

  // The page sends the mouse every 50 ms; a whisker follows faster.
  const later = window.setTimeout.bind(window);
  window.setTimeout = (job, delay, ...rest) => later(job, delay === 50 ? 16 : delay, ...rest);

  // Smooth edges take four times the work: no more than what a graphics card does in passing, but
  // most of a frame where there is none.
  const plain = HTMLCanvasElement.prototype.getContext;
  let slow = null;
  const inSoftware = () => {
    const gl = plain.call(document.createElement("canvas"), "webgl2");
    const info = gl && gl.getExtension("WEBGL_debug_renderer_info");
    const name = info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
    if (gl) gl.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
  };
  HTMLCanvasElement.prototype.getContext = function (kind, options, ...rest) {
    if (options && options.antialias && kind.startsWith("webgl")) {
      slow ??= inSoftware();
      if (slow) options = { ...options, antialias: false };
    }
    return plain.call(this, kind, options, ...rest);
  };

  // Changes of what is there are taken in at once, not at the next frame, which would draw them
  // only a frame later.
  const changes = new Set([
    "SceneNodeUpdateMessage", "SetPositionMessage", "SetOrientationMessage", "GuiUpdateMessage",
    "SetSceneNodeVisibilityMessage",
  ]);
  const take = ({ type, messages }) => {
    const page = window.__viserMutable;
    if (type !== "message_batch" || !page || page.firstMessageBatch) return;
    if (page.getRenderRequestState !== "ready" || !page.drainMessageQueue) return;
    if (page.messageQueue.length !== messages.length) return;
    if (messages.every((message) => changes.has(message.type))) page.drainMessageQueue();
  };
  window.Worker = class extends Worker {
    set onmessage(heard) {
      super.onmessage = (event) => { heard(event); take(event.data); };
    }
    get onmessage() { return super.onmessage; }
  };

  const furnish = () => {
    const page = window.__viserMutable, root = page?.scene?.__r3f?.root?.getState?.();
    if (!page?.backgroundMaterial || !root) return later(furnish, 100);
    // A pane for background images is drawn over the whole window although there is no image.
    page.scene.traverse((thing) => {
      if (thing.material === page.backgroundMaterial) thing.visible = false;
    });
    // Labels in space are black on white boxes, in any page; a saved picture is on white.
    const night = { value: 0 };
    if (dark.matches) page.scene.onBeforeRender = () => {
      night.value = page.getRenderRequestState === "capture" ? 0 : 1;
      page.scene.traverse(({ material }) => {
        if (!material?.uniforms?.uLabelData || material.fragmentShader.includes("night")) return;
        material.uniforms.night = night;
        material.fragmentShader = "uniform float night;\n" + material.fragmentShader
          .replace("vec4(1.0, 1.0, 1.0, 0.85 * vAlpha)",
            "vec4(vec3(1.0 - 0.92 * night), (0.85 - 0.15 * night) * vAlpha)")
          .replace("vec4(0.0, 0.0, 0.0, a)", "vec4(vec3(0.9 * night), a)");
        material.needsUpdate = true;
      });
    };
    // A mouse that drags, and whatever changes, asks for frames for a quarter of a second. Where
    // each takes its time they would keep that from being drawn which they wait for.
    if (!slow) return;
    let ask = page.requestRender, last = 0;
    const thrifty = () => {
      const held = page.cameraControl?.enabled === false;  // something, not the view
      if (!held || window.event?.type !== "pointermove") root.invalidate();
      clearTimeout(last);
      last = later(() => ask(), 150);
    };
    Object.defineProperty(page, "requestRender", { get: () => thrifty, set: (f) => { ask = f; } });
  };
  furnish();
})();
