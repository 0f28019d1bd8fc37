"""The page in a real browser: it loads in silence, follows the mouse, and says why it cannot."""

import urllib.request
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.viewer.readout import number
from vibrissa.viewer.state import shape_of

SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
SIZE = {"width": 900, "height": 480}


class Looking:
    """Someone who looks at a page with a mouse, and hears what it complains of."""

    def __init__(self, browser, viewer):
        self.viewer = viewer
        self.complaints = []
        self.page = browser.new_page(viewport=SIZE)
        self.page.set_default_timeout(90e3)  # 3D is drawn by software, perhaps on a busy machine
        self.page.on("console", self._hear)
        self.faults = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.requests = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(viewer.url)
        self.page.wait_for_selector('[data-quantity="MB"]')
        self.page.wait_for_function("document.querySelector('canvas') !== null")

    def _hear(self, message):
        if message.type == "error":
            self.complaints.append(message.text)

    def pixel(self, place):
        """Where a place, m, is on the screen."""
        deadline = 200
        while not (clients := self.viewer.page.server.get_clients()) and deadline:
            self.page.wait_for_timeout(50)
            deadline -= 1
        camera = next(iter(clients.values())).camera
        w, *v = camera.wxyz
        v = -np.array(v)  # from the world to the camera: right, down, forward
        away = 1e3 * np.asarray(place) - camera.position
        turned = away + 2.0 * np.cross(v, np.cross(v, away) + w * away)
        focal = 0.5 * SIZE["height"] / np.tan(0.5 * camera.fov)
        middle = 0.5 * np.array([SIZE["width"], SIZE["height"]])
        return middle + focal * turned[:2] / turned[2]

    def drag(self, start, by, steps=5):
        """Take hold at a pixel and move the mouse by so many pixels."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            mouse.move(*(start + share * np.asarray(by)))
            self.page.wait_for_timeout(25)
        mouse.up()
        self.page.wait_for_timeout(150)
        assert self.viewer.page.settle()

    def drag_until(self, done, by):
        """Drag what is bent until that has come true: a busy page may miss the mouse."""
        for _ in range(10):
            self.drag(self.pixel(self.viewer.page.bend.point), by)
            if done():
                return
        raise AssertionError("dragging has no effect")

    def wait_until(self, true):
        """Wait until something is true, of what may still be on its way to the page."""
        for _ in range(300):
            if true():
                return
            self.page.wait_for_timeout(100)
        raise AssertionError("it never came true")

    def text(self, name):
        """What is shown for a quantity."""
        return self.page.locator(f'[data-quantity="{name}"]').first.inner_text()

    def wait_for(self, selector, text=None):
        """Wait until something is on the page."""
        self.page.locator(selector, has_text=text).first.wait_for(state="attached")


@pytest.fixture(scope="module")
def looking(browser):
    from vibrissa.viewer import view

    with view(vb.samples.gamma()) as viewer:
        person = Looking(browser, viewer)
        yield person
        person.page.close()


def test_the_page_loads_in_silence_and_asks_nobody_else(looking):
    looking.page.wait_for_timeout(500)
    assert looking.complaints == looking.faults == []
    assert looking.page.title() == "vibrissa"
    # What is put into the page relies on how viser made it: without a graphics card edges are not
    # smoothed, and the pane for background images is not drawn.
    canvas = "document.querySelector('canvas[data-engine]').getContext('webgl2')"
    assert looking.page.evaluate(f"{canvas}.getContextAttributes().antialias") is False
    looking.page.wait_for_function(
        """() => {
          let hidden = false;
          __viserMutable.scene.traverse((thing) => {
            if (thing.material === __viserMutable.backgroundMaterial) hidden = !thing.visible;
          });
          return hidden;
        }"""
    )
    assert all(url.startswith((looking.viewer.url, "blob:")) for url in looking.requests)


def test_a_saved_picture_of_a_dark_page_is_that_of_a_light_one(browser, looking):
    from vibrissa.viewer.save import _render

    assert looking.viewer.page.settle()
    light = looking.viewer.page.server.get_clients()
    dark = browser.new_page(viewport=SIZE, color_scheme="dark")
    dark.goto(looking.viewer.url)
    dark.wait_for_function("document.querySelector('canvas') !== null")
    clients = looking.viewer.page.server.get_clients
    looking.wait_until(lambda: len(clients()) == len(light) + 1)
    night = next(client for key, client in clients().items() if key not in light)
    day = next(iter(light.values()))
    # The first pictures may lack what the page has not loaded yet.
    assert any(np.array_equal(_render(day, 1.0), _render(night, 1.0)) for _ in range(20))
    dark.close()


def test_a_drag_shows_what_deflect_says(looking):
    before = looking.text("MB")
    start = looking.viewer.page.bend.point
    page = looking.viewer.page
    looking.drag_until(lambda: np.linalg.norm(page.bend.point - start) > 0.3e-3, [0.0, -18.0])

    def agrees():
        bent = vb.deflect(page.bend.whisker, vb.PointContact(page.bend.point))
        assert vb.Status(int(bent.status)).ok
        signals = vb.base_signals(bent.force, bent.moment)
        return all(looking.text(name) == number(name, float(signals[name])) for name in SIGNALS)

    looking.wait_until(agrees)
    assert looking.text("MB") != before


def test_out_of_reach_the_reason_is_shown(looking):
    page = looking.viewer.page
    beyond = (vb.Status.BEYOND_FOLD, vb.Status.BEYOND_TIP)
    looking.drag_until(lambda: page.bend.status in beyond, [0.0, -170.0])
    bend = page.bend
    looking.wait_for(f'[data-status="{bend.status.name}"]', bend.status.explanation)
    assert looking.viewer.page.stage.node("bend", "ghost") is not None
    assert looking.faults == []


def test_a_click_on_a_solid_marks_the_contact_in_all_spaces(looking):
    page = looking.viewer.page
    looking.page.get_by_role("button", name="Map").click()
    looking.wait_for("[data-note]", "Click on a solid")
    assert page.settle()
    mode = page.modes["Map"]
    solids = mode._solids
    # One that stands below what the page may have to say at its upper left.
    places = solids.seen(solids.skin(), 2).mean(axis=1)[::40] / 1e3
    for attempt in range(40):  # until the camera has moved and the solids are drawn
        place = places[(7 * attempt) % len(places)]
        looking.page.mouse.click(*looking.pixel(place))
        looking.page.wait_for_timeout(500)
        assert page.settle()
        if mode.row is not None:
            break
    looking.wait_for('[data-quantity="arc_length"]')
    for space in (None, 0, 1, 2):
        assert page.stage.node("picked", f"mark {space}") is not None
    assert looking.faults == []


def test_a_trial_plays(browser, recording):
    from vibrissa.recording import Recording
    from vibrissa.viewer import view

    with view(Recording(recording).whisker(), recording=recording) as viewer:
        person = Looking(browser, viewer)
        trial = viewer.page.modes["Trial"]
        person.page.get_by_role("button", name="contact ▶").click()
        start = float(trial.trial.time[trial.trial.onset_from(0)])
        share = start / float(np.ptp(trial.trial.time))
        person.wait_for(f'[data-cursor="{share:.4f}"]')
        trial.hurry("1 : 50")  # so that it is still playing when a busy machine looks
        person.page.get_by_role("button", name="Play").click()
        person.wait_for("button", "Pause")
        person.page.wait_for_function(
            "share => document.querySelector('[data-cursor]').dataset.cursor > share + 0.005",
            arg=share,
        )
        trial.pause()
        assert trial.trial.time[trial.frame] > start
        moment = trial.trial.signals["MB"][:, 0]
        person.wait_until(lambda: person.text("MB") == number("MB", float(moment[trial.frame])))
        assert person.faults == []
        person.page.close()


def test_keys_clicks_and_links_lead_through_a_trial(browser, recording):
    from vibrissa.recording import Recording
    from vibrissa.viewer import view

    with view(Recording(recording).whisker(), recording=recording) as viewer:
        person = Looking(browser, viewer)
        trial = viewer.page.modes["Trial"]
        last = len(trial.trial.time) - 1
        person.wait_for("button", "frame ▶")
        first = trial.frame
        person.page.keyboard.press(".")
        person.wait_until(lambda: trial.frame == first + 1)
        person.page.keyboard.press(",")
        person.wait_until(lambda: trial.frame == first)
        person.page.keyboard.press("n")
        onset = trial.trial.onset_from(first)
        person.wait_until(lambda: trial.frame == onset)
        keys = (("End", last), ("p", trial.trial.onsets()[-1]), ("Home", 0))
        for key, frame in 3 * keys:  # none is lost, however soon it follows another
            person.page.keyboard.press(key)
            person.wait_until(lambda frame=frame: trial.frame == frame)
        (client,) = viewer.page.server.get_clients().values()

        def height():
            """Share of the height in the direction from which things are looked at."""
            away = client.camera.position - client.camera.look_at
            return away[2] / np.linalg.norm(away)

        person.page.get_by_role("button", name="Top", exact=True).click()
        person.wait_until(lambda: height() > 0.999)
        person.page.keyboard.press("a")
        person.wait_until(lambda: height() < 0.9)
        # A click on a contact point goes to its time.
        touched = np.flatnonzero(trial.trial.touching[:, 0])
        trial.show(int(touched[-1]))
        point, away = trial.trial.contacts[touched[0], 0], np.array([0.03, -0.06, 0.04])
        wanted = trial.trial.contact_at(int(touched[-1]), point + away, -away)
        trial.pick((point + away) * 1e3, -away)
        person.wait_until(lambda: trial.frame == wanted)
        # What is at the bottom of the window covers plots that have been scrolled there.
        on_top = """plot => {
          const box = plot.getBoundingClientRect();
          return plot.contains(
            document.elementFromPoint(box.x + 0.5 * box.width, box.y + 0.5 * box.height));
        }"""
        plots = person.page.locator("svg[data-seek]").all()
        plot = next(one for one in plots if one.evaluate(on_top))
        box, left = plot.bounding_box(), float(plot.get_attribute("data-seek"))
        middle = (left + 0.5 * (1.0 - left)) * (box["width"] - 8)
        person.page.mouse.move(box["x"] + box["width"] - 30, box["y"] + 0.5 * box["height"])
        person.page.mouse.down()
        person.wait_until(lambda: trial.frame > 0.8 * last)
        person.page.mouse.move(box["x"] + middle, box["y"] + 0.5 * box["height"], steps=3)
        person.page.wait_for_timeout(60)
        person.page.mouse.move(box["x"] + middle + 1, box["y"] + 0.5 * box["height"])
        person.wait_until(lambda: abs(trial.frame - 0.5 * last) < 0.05 * last)
        person.page.mouse.up()
        there = trial.frame
        person.page.wait_for_function("/t=0[.][45]/.test(location.hash)")
        link = person.page.evaluate("location.href")
        assert "mode=Trial" in link
        assert "camera=" not in link
        trial.show(0)
        person.wait_until(lambda: trial.frame == 0)
        second = browser.new_page(viewport=SIZE)
        second.goto(link)
        person.wait_until(lambda: trial.frame == there)
        second.close()
        # A link of another mode brings its signals, colours and contact.
        third = browser.new_page(viewport=SIZE)
        words = "mode=Locate&signals=Fx+FT+MB&noise=2,0.05&colours=MB&contact=24,3,4"
        third.goto(f"{viewer.url}/#{words}")
        person.wait_until(lambda: viewer.page.mode.name == "Locate")
        locate = viewer.page.modes["Locate"]
        person.wait_until(
            lambda: locate.found is not None and locate.found.sensor.triplet == ("Fx", "FT", "MB")
        )
        person.wait_until(lambda: np.allclose(viewer.page.bend.point, [24e-3, 3e-3, 4e-3]))
        third.wait_for_function("/noise=2%2C0.05&colours=MB&contact=24%2C3/.test(location.hash)")
        # It brings the whisker's shape too, and the camera if someone has turned the view.
        third.mouse.move(300, 200)
        third.mouse.down()
        third.mouse.move(380, 230, steps=4)
        third.mouse.up()
        third.wait_for_function("location.hash.includes('camera=')")
        viewer.page.reshape(length=50e-3, turn=0.5)
        third.wait_for_function("location.hash.includes('whisker=50%2C28.6')")
        link = third.evaluate("location.href")
        (words,) = parse_qs(urlsplit(link).fragment)["camera"]
        wanted = np.array(words.split(","), dtype=float)
        viewer.page.reshape(**vars(shape_of(viewer.page.original)))
        third.close()
        viewer.page.choose("Bend")
        person.wait_until(lambda: viewer.page.mode.name == "Bend")
        fourth = browser.new_page(viewport=SIZE)
        fourth.goto(link)
        person.wait_until(lambda: abs(viewer.page.bend.whisker.length - 50e-3) < 1e-9)

        def as_turned():
            clients = viewer.page.server.get_clients()
            return clients and np.allclose(
                np.concatenate([(c := clients[max(clients)].camera).position, c.look_at]),
                wanted,
                atol=0.01,
            )

        person.wait_until(as_turned)
        for nonsense in (
            "mode=None",
            "mode=Locate&contact=a,b&signals=Mx&noise=-1,1",
            "mode=Bend&whisker=nan,1,2,3&camera=1,2",
            "mode=Trial&t=nan",
        ):
            urllib.request.urlopen(f"{viewer.url}/restore?{nonsense}").close()
        person.wait_until(lambda: viewer.page.mode is trial)
        fourth.close()
        assert person.faults == []
        person.page.close()
