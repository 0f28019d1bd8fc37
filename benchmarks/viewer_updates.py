# ruff: noqa: T201 -- a script that reports
"""How fast a whisker follows the mouse on the viewer's page, from end to end.

    python benchmarks/viewer_updates.py [SECONDS]

Chromium shows the page, the mouse takes hold of the contact of the built-in γ whisker and goes
round in a circle, 60 positions a second. Server and browser are processes of their own, as for a
user. Every shape that the page gets tells by its contact point which position of the mouse it
answers, so each is followed on its way:

    event    the browser tells the page that the mouse moved
    sent     the page has passed the position to its connection
    heard    the server has it
    bent     the server has bent the whisker and told what is to be drawn
    arrived  the page has the new shape
    drawn    the page hands the shape to the graphics

Twice: as it is, with the graphics in software (no graphics card is used), and with the graphics
told to draw nothing, which leaves what the page itself takes.
"""

import multiprocessing
import shutil
import sys
import time

import numpy as np
from playwright.sync_api import sync_playwright

import vibrissa as vb
from vibrissa.viewer import view

SIZE = {"width": 1280, "height": 720}
CHROMIUM = [
    "--no-sandbox",
    "--disable-gpu",  # the page around the picture needs no graphics
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
STEPS = ("event", "sent", "heard", "bent", "arrived", "drawn")

LISTEN = """
(() => {
  const now = () => performance.timeOrigin + performance.now();
  const log = (window.vibrissaLog = { sent: [], arrived: [], drawn: [], batches: 0, frames: 0 });
  let moved = 0, held = null;
  addEventListener("pointerdown", (e) => { held = e; }, true);
  addEventListener("pointermove", (e) => { moved = performance.timeOrigin + e.timeStamp; }, true);
  // What the hand does: as a browser tells it, with the frames.
  window.vibrissaDrag = (seconds) => new Promise((done) => {
    const start = performance.now();
    const move = (time) => {
      const passed = (time - start) / 1e3, turn = 3.8 * passed;
      if (passed > seconds) return done(passed);
      held.target.dispatchEvent(new PointerEvent("pointermove", {
        bubbles: true, buttons: 1, isPrimary: true,
        pointerId: held.pointerId, pointerType: "mouse",
        // Never quite the same way, so that each position is told from all others.
        clientX: held.clientX + 22 * Math.sin(turn),
        clientY: held.clientY + 14 * (Math.cos(0.6180339887 * turn) - 1),
      }));
      requestAnimationFrame(move);
    };
    requestAnimationFrame(move);
  });
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (data, ...rest) {
    const said = data && data.message;
    if (said && said.type === "SceneNodeDragMessage" && said.phase === "update")
      log.sent.push([moved, now(), ...said.end_position]);
    return post.call(this, data, ...rest);
  };
  const ends = new Map();  // tips of whiskers that have come, and the contacts they belong to
  window.Worker = class extends Worker {
    constructor(...words) {
      super(...words);
      this.addEventListener("message", ({ data }) => {
        if (data.type !== "message_batch") return;
        log.batches += 1;
        let tip = null, contact = null;
        for (const m of data.messages) {
          if (m.type !== "SceneNodeUpdateMessage") continue;
          if (m.name === "/bend/whisker" && m.updates.vertices) tip = m.updates.vertices;
          if (m.name === "/bend/force" && m.updates.points) contact = m.updates.points;
        }
        if (tip === null || contact === null) return;
        const at = Array.from(contact.slice(3, 6));
        ends.set(tip[tip.length - 3], at);
        log.arrived.push([now(), ...at]);
      });
    }
  };
  const gl = WebGL2RenderingContext.prototype;
  const upload = gl.bufferSubData, clear = gl.clear;
  gl.bufferSubData = function (target, offset, data, ...rest) {
    const at = data && data.length > 300 && ends.get(data[data.length - 3]);
    if (at) { log.drawn.push([now(), ...at]); ends.delete(data[data.length - 3]); }
    return upload.call(this, target, offset, data, ...rest);
  };
  gl.clear = function (mask) { log.frames += 1; return clear.call(this, mask); };
})();
"""
BLANK = """
for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"])
  WebGL2RenderingContext.prototype[name] = () => {};
"""


def serve(pipe):
    """Serve the page, and tell when positions came, when they were answered, and how much went."""
    from websockets.asyncio.connection import Connection

    heard, bent, sizes, cpu = [], [], [], []
    with view(vb.samples.gamma()) as viewer:
        page, send = viewer.page, Connection.send
        change, redraw, told = page.change, page.redraw, page.grip._moved

        def counted(connection, message, *rest):
            sizes.append(len(message))
            return send(connection, message, *rest)

        def moved(place, turn):
            heard.append([1e3 * time.time(), *(1e3 * place)])
            told(place, turn)

        def changed(topic, transition, dragging=False):
            def begun(bend):
                cpu.append(-time.thread_time())
                return transition(bend)

            change(topic, begun, dragging)

        def redrawn(dragging=False):
            redraw(dragging)
            if dragging and cpu:
                cpu[-1] += time.thread_time()
                bent.append([1e3 * time.time(), *(1e3 * page.bend.target)])

        Connection.send, page.grip._moved = counted, moved
        page.change, page.redraw = changed, redrawn
        camera = page.server.initial_camera
        seen = (camera.position, camera.look_at, camera.fov)
        start = page.bend.point
        pipe.send((viewer.url, 1e3 * start, seen))
        while (asked := pipe.recv()) != "stop":
            if asked == "begin":
                viewer.put_contact(start)
            pipe.send({"heard": heard[:], "bent": bent[:], "sizes": sizes[:], "cpu": cpu[:]})
            for kept in (heard, bent, sizes, cpu):
                kept.clear()


def on_screen(place, camera):
    """Where a place, mm, is on the screen."""
    position, look_at, fov = (np.asarray(value) for value in camera)
    ahead = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = place - position
    seen = np.array([away @ right, -away @ np.cross(right, ahead)]) / (away @ ahead)
    focal = 0.5 * SIZE["height"] / np.tan(0.5 * fov)
    return 0.5 * np.array([SIZE["width"], SIZE["height"]]) + focal * seen


def followed(times):
    """Times (n, steps), ms, of shapes that were drawn: each position from step to step."""
    rows = []
    for end in times["drawn"]:
        row = [end[0]]
        for step in ("arrived", "bent", "heard", "sent"):
            known = times[step]
            away = np.linalg.norm(known[:, -3:] - end[-3:], axis=1)
            if away.min() > 1e-3:
                break
            found = known[away.argmin()]
            row += [found[0]] if step != "sent" else [found[1], found[0]]
        else:
            rows.append(row[::-1])
    return np.array(rows)


def measured(browser, pipe, start, drawing, seconds):
    """Drag, and report."""
    url, point, camera = start
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(60e3)
    page.add_init_script(LISTEN + ("" if drawing else BLANK))
    pipe.send("begin")
    pipe.recv()
    page.goto(url)
    page.wait_for_selector('[data-quantity="MB"]')
    page.wait_for_timeout(6000)  # until all is there, and compiled
    probe = page.context.new_cdp_session(page)
    probe.send("Performance.enable", {"timeDomain": "threadTicks"})
    pipe.send("tell")
    pipe.recv()
    middle = on_screen(point, camera)
    page.mouse.move(*middle)
    page.mouse.down()
    page.evaluate("vibrissaDrag(1)")
    page.evaluate("for (const list of Object.values(vibrissaLog)) list.length = 0")
    page.evaluate("vibrissaLog.batches = vibrissaLog.frames = 0")
    before = costs(browser, probe)
    pipe.send("tell")
    pipe.recv()
    lasted = page.evaluate("seconds => vibrissaDrag(seconds)", seconds)
    after = costs(browser, probe)
    page.wait_for_timeout(500)
    pipe.send("tell")
    server, log = pipe.recv(), page.evaluate("vibrissaLog")
    shown = page.evaluate(
        "(({width, height}) => `${width} × ${height}`)"
        "(document.querySelector('canvas[data-engine]'))"
    )
    page.mouse.up()
    page.close()
    times = {name: np.array(log[name]) for name in ("sent", "arrived", "drawn")}
    times |= {name: np.array(server[name]) for name in ("heard", "bent")}
    report(followed(times), times, server, lasted)
    count = len(times["drawn"])
    print(f"  in the end {shown} pixels are drawn (the page takes fewer where it is slow)")
    print(f"  {log['batches'] / count:.2f} batches of messages, {log['frames'] / count:.2f} frames")
    for name in after:
        print(f"  {name:26} {1e3 * (after[name] - before.get(name, 0.0)) / count:6.1f} ms")


def costs(browser, probe):
    """Seconds of CPU: what the page's thread has spent on what, and the browser's processes."""
    wanted = ("TaskDuration", "ScriptDuration", "LayoutDuration", "RecalcStyleDuration")
    found = probe.send("Performance.getMetrics")["metrics"]
    out = {f"page: {each['name']}": each["value"] for each in found if each["name"] in wanted}
    whole = browser.new_browser_cdp_session()
    for each in whole.send("SystemInfo.getProcessInfo")["processInfo"]:
        name = f"process: {each['type']}"
        out[name] = out.get(name, 0.0) + each["cpuTime"]
    whole.detach()
    return out


def report(ways, times, server, lasted):
    """Print rates and latencies."""
    for name in ("sent", "heard", "bent", "arrived", "drawn"):
        print(f"  {name:8} {len(times[name]) / lasted:6.1f} a second")
    sizes = np.array(server["sizes"])
    print(f"  {sizes.sum() / len(times['bent']) / 1e3:.1f} kB a shape")
    print(f"  server's thread {1e3 * np.median(server['cpu']):.2f} ms of CPU a shape")
    print(f"  {'from':8}   {'to':8}  median   99 %  (ms)")
    pairs = [(i, i + 1) for i in range(len(STEPS) - 1)] + [(0, len(STEPS) - 1)]
    for a, b in pairs:
        took = ways[:, b] - ways[:, a]
        median, most = np.quantile(took, [0.5, 0.99])
        print(f"  {STEPS[a]:8} → {STEPS[b]:8} {median:6.1f} {most:6.1f}")


def main(seconds=10.0):
    here, there = multiprocessing.get_context("spawn").Pipe()
    server = multiprocessing.get_context("spawn").Process(target=serve, args=(there,))
    server.start()
    start = here.recv()
    with sync_playwright() as play:
        path = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = play.chromium.launch(executable_path=path, args=CHROMIUM)
        for drawing in (False, True):
            print("with drawing in software" if drawing else "without drawing")
            measured(browser, here, start, drawing, seconds)
        browser.close()
    here.send("stop")
    server.join()


if __name__ == "__main__":
    main(*(float(word) for word in sys.argv[1:]))
