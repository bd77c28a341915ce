"""Takes the pictures of README and the docs: .venv/bin/python tests/browser/take_screenshots.py [NAME ...]

Not a test. It opens the real pages and writes ``web_assets/screenshots/dark/NAME.jpg`` and ``light/NAME.jpg``, all of one size,
and the animated ``demo.webp`` (`film.py`). Names select from `SHOTS`; without any, all are taken, in about ten minutes.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal

from PIL import Image
from playwright.sync_api import Browser, Page, expect

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.browser.film import take_film
from tests.browser.tutorial_pictures import take_steps, text_after
from tests.docs.commands import commands
from tests.docs.walk import FILE, STEPS, after
from tests.drive.page import browser_at, close_notice, new_page, open_workbench, with_empty_settings
from workbench.machine.doctor import find_chromium, how_to_get_chromium

ROOT = Path(__file__).parents[2]
OUT = ROOT / "web_assets" / "screenshots"
TASK = ROOT / "tasks" / "push_cube.py"
POLICY = Path(__file__).parent / "pusher.py"
CONTROL = ("--env", "control_mode=pd_ee_delta_pos")
"""The control mode that the policy needs."""
THEMES = ("dark", "light")
BEST_COMPRESSION = {"jpg": {"optimize": True}, "webp": {"method": 6}}
FRAME_SECONDS = 4.0
"""Time that a software-rendering browser may need for a frame of the 3-D view."""


@dataclass
class Desk:
    page: Page
    file: Path
    """The task file, a copy of the example."""
    theme: Literal["dark", "light"] = "dark"

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def button(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def press(self, *keys: str) -> None:
        # A focused input would take the keys.
        self.page.evaluate("document.activeElement?.blur()")
        for key in keys:
            self.page.keyboard.press(key)
            time.sleep(0.1)

    def choose(self, label: str, option: str) -> None:
        self.page.get_by_label(label, exact=True).locator("visible=true").last.select_option(label=option)

    def edit(self, old: str, new: str) -> None:
        """Save the example with `old` replaced by `new`."""
        text = TASK.read_text()
        assert old in text
        self.file.write_text(text.replace(old, new, 1))

    def step(self, steps: int) -> None:
        """Make exactly this many steps, also on a busy machine; return when the page shows the last."""
        self.press(*steps * ["s"])
        timeline = self.page.locator(".wb-timeline")
        shown = ""
        while shown != (shown := timeline.inner_text()):
            time.sleep(3.0)

    def wear(self, theme: Literal["dark", "light"]) -> None:
        if theme != self.theme:
            self.press("d")
            self.theme = theme
            time.sleep(1.0)

    def shoot(
        self,
        name: str,
        take: Callable[[Page], Image.Image] | None = None,
        kind: Literal["jpg", "webp"] = "jpg",
        quality: int = 82,
    ) -> None:
        """Write the picture with this name, dark and light."""
        for theme in THEMES:
            self.wear(theme)
            # Away from anything with a tooltip.
            self.page.mouse.move(400, 10)
            time.sleep(FRAME_SECONDS)
            image = picture_of(self.page) if take is None else take(self.page)
            path = OUT / theme / f"{name}.{kind}"
            path.parent.mkdir(parents=True, exist_ok=True)
            image.convert("RGB").save(path, quality=quality, **BEST_COMPRESSION[kind])
            print(path, flush=True)
        self.wear("dark")


def picture_of(page: Page) -> Image.Image:
    return Image.open(BytesIO(page.screenshot()))


@contextmanager
def live_page(
    browser: Browser, *arguments: str, task: str = "", name: str = TASK.name, checks: bool = False
) -> Iterator[Desk]:
    """The page of a copy of the example, paused; `task` replaces the text and `name` the file name."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_text(task or TASK.read_text())
        shutil.copy(POLICY, file.parent)
        with open_workbench(str(file), *arguments, cwd=file.parent, checks=checks) as opened:
            page, _ = new_page(browser, timeline=False)
            page.goto(opened.url)
            expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(
                timeout=120_000
            )
            close_notice(page)
            hints = page.get_by_text("close for good", exact=True)
            if hints.is_visible():
                hints.click()
            yield Desk(page, file)
            page.close()


def take_policy(desk: Desk) -> None:
    """Choose the policy, which overshoots in every fifth env."""
    desk.choose("Source", "policy")
    desk.choose("Known", f"{POLICY.name}:act")
    time.sleep(3)


# --- the live page ------------------------------------------------------------------------------------


def shoot_page(browser: Browser) -> None:
    """While the task plays: the Run tab, the cameras, and a misspelt name in the file."""
    with live_page(browser, "--num-envs", "16", *CONTROL) as desk:
        desk.tab("Cameras")
        desk.page.get_by_text("All pictures", exact=True).click()
        expect(desk.page.get_by_text("rendered in").first).to_be_visible(timeout=60_000)
        desk.tab("Run")
        take_policy(desk)
        desk.press("Space")
        desk.tab("Reward")
        time.sleep(15)
        desk.shoot("page")
        desk.tab("Run")
        desk.shoot("run")
        desk.press("Space")
        desk.tab("Cameras")
        # The chosen camera's own picture would stay above the others.
        desk.choose("Camera", "none")
        for tick in desk.page.locator("input[type=checkbox]:visible").all()[:3]:
            tick.check(force=True)
        desk.page.get_by_text("base_camera · sensor", exact=True).last.evaluate("e => e.scrollIntoView()")
        desk.shoot("cameras")
        desk.tab("Reward")
        desk.edit('"cube_to_goal": distance', '"cube_to_goal": distanec')
        expect(desk.page.get_by_text("NameError").locator("visible=true").first).to_be_visible(timeout=60_000)
        desk.shoot("banner")


def shoot_reload(browser: Browser) -> None:
    """The Run tab after a patched and after a rebuilt version, side by side."""
    edits = {
        "patched in": ("return reward\n", "return reward + 1\n"),
        "rebuilt in": ('name="goal")', 'name="target")'),
    }
    with live_page(browser, "--num-envs", "16") as desk:
        taken: dict[str, list[Image.Image]] = {theme: [] for theme in THEMES}
        for level, edit in edits.items():
            desk.edit(*edit)
            expect(desk.page.get_by_text(level).first).to_be_visible(timeout=60_000)
            desk.page.get_by_text("Code version", exact=True).scroll_into_view_if_needed()
            desk.page.get_by_text("Reload by hand", exact=True).scroll_into_view_if_needed()
            for theme in THEMES:
                desk.wear(theme)
                time.sleep(FRAME_SECONDS)
                whole = picture_of(desk.page)
                left = (desk.page.locator("[data-dock-region=right]").bounding_box() or {"x": 0.0})["x"]
                taken[theme].append(whole.crop((int(left), 0, whole.width, whole.height)))
            desk.wear("dark")
        # Next to the current view, so that all pictures have the same size.
        both = {
            theme: beside(whole_of, taken[theme])
            for theme, whole_of in ((t, picture_in(desk, t)) for t in THEMES)
        }
        desk.shoot("reload", lambda page: both[desk.theme])


def picture_in(desk: Desk, theme: Literal["dark", "light"]) -> Image.Image:
    desk.wear(theme)
    time.sleep(FRAME_SECONDS)
    return picture_of(desk.page)


def beside(whole: Image.Image, panels: list[Image.Image]) -> Image.Image:
    """The view with both panels at its right edge."""
    made = whole.copy()
    x = whole.width
    for panel in reversed(panels):
        x -= panel.width
        made.paste(panel, (x, 0))
    return made


def shoot_envs(browser: Browser) -> None:
    """The table of envs: a policy that overshoots in every fifth env, and one env with a NaN."""
    good, lost = '"cube_height": height', "(self.elapsed_steps >= 20) & (torch.arange(len(height)) == 11)"
    text = TASK.read_text()
    assert good in text
    text = text.replace(good, f"{good}.masked_fill({lost}, torch.nan)")
    with live_page(browser, "--num-envs", "16", *CONTROL, task=text) as desk:
        take_policy(desk)
        desk.tab("Reward")
        desk.step(62)
        desk.press("Shift+E", "f")
        desk.shoot("envs")


def shoot_studio(browser: Browser) -> None:
    """A camera is chosen and moved with keys, and the change is shown; then it is measured over the envs."""
    with live_page(browser, "--num-envs", "4") as desk:
        desk.tab("Cameras")
        desk.choose("Camera", "base_camera · sensor")
        expect(desk.page.get_by_text("Show the change", exact=True)).to_be_visible()
        desk.press(*12 * ["Alt+ArrowLeft"], *12 * ["Alt+Shift+ArrowRight"])
        desk.page.get_by_role("button", name="Show the change").click()
        write = desk.page.get_by_role("button", name=re.compile("^Save to"))
        write.evaluate("e => e.scrollIntoView({block: 'end'})")
        desk.shoot("studio")


def shoot_measured_camera(browser: Browser) -> None:
    """A camera measured over all envs: the table, the depths, and the pictures."""
    with live_page(browser, "--num-envs", "16") as desk:
        desk.step(20)
        desk.tab("Cameras")
        desk.choose("Camera", "base_camera · sensor")
        desk.page.get_by_text("Measure", exact=True).click()
        measure = desk.page.get_by_role("button", name="Measure this camera")
        measure.click()
        expect(desk.page.locator(".wb-planes")).to_be_visible()
        desk.page.get_by_role("button", name="Pictures of all envs").click()
        envs = desk.page.locator(".wb-sheet figure")
        expect(envs).to_have_count(16)
        envs.first.click()
        measure.evaluate("e => e.scrollIntoView({block: 'start'})")
        desk.shoot("measured_camera")


def shoot_branch(browser: Browser) -> None:
    """The selected env goes back some steps and continues; then a moment of that branch is shown."""
    with live_page(browser, "--num-envs", "16", *CONTROL) as desk:
        take_policy(desk)
        desk.step(40)
        desk.press(*18 * ["ArrowLeft"], "Shift+G")
        time.sleep(2)
        desk.step(25)
        desk.tab("Reward")
        desk.press(*5 * ["ArrowLeft"], "t")
        desk.shoot("branch")


def shoot_rescored(browser: Browser) -> None:
    """A more lenient reward is saved: how it changes past episodes, and one moment of them."""
    with live_page(browser, "--num-envs", "16", *CONTROL) as desk:
        take_policy(desk)
        desk.step(70)
        desk.tab("Reward")
        desk.edit("reach = 1 - torch.tanh(5 * distance)", "reach = 1 - torch.tanh(3 * distance)")
        rows = desk.page.locator(".wb-again-table tbody tr")
        expect(rows.nth(1)).to_be_visible(timeout=120_000)
        rows.nth(1).click()
        expect(rows.nth(1)).to_have_class("wb-selected")
        time.sleep(2.0)
        # By script: the element is redrawn while Playwright scrolls to it.
        desk.page.locator(".wb-again-more").evaluate("more => more.scrollIntoView({ block: 'nearest' })")
        desk.shoot("rescored")


def shoot_checks(browser: Browser) -> None:
    """A goal that is reached at reset: the finding, why it matters, and how to fix it."""
    text, good = TASK.read_text(), "(distance < GOAL_RADIUS)"
    assert good in text
    text = text.replace(good, "(distance < 3 * GOAL_RADIUS)")
    with live_page(browser, "--num-envs", "16", *CONTROL, task=text, checks=True) as desk:
        desk.tab("Checks")
        expect(desk.page.get_by_text(re.compile(r"^\d+ rules checked in "))).to_be_visible(timeout=240_000)
        desk.page.locator("[data-rule=success-at-reset]").get_by_text("Why, fix").click()
        desk.shoot("checks")


def shoot_solve(browser: Browser) -> None:
    """Some steps of a plan, paused: the rollouts and their returns."""
    with live_page(browser, "--num-envs", "1", "--env", "control_mode=pd_ee_delta_pose") as desk:
        desk.choose("Source", "solve")
        desk.tab("Try")
        for step in range(1, 4):
            desk.button("Step")
            expect(desk.page.locator(".wb-timeline").get_by_text(f"step {step} /")).to_be_visible(
                timeout=60_000
            )
        title = desk.page.get_by_role("button", name="Solve", exact=True).or_(
            desk.page.get_by_text("Solve", exact=True)
        )
        title.first.evaluate("e => e.scrollIntoView({block: 'start'})")
        desk.shoot("solve")


def shoot_hands(browser: Browser) -> None:
    """The cube is selected, with the handles that move it."""
    with live_page(browser, "--num-envs", "4") as desk:
        desk.step(5)
        desk.press("Control+k")
        desk.page.keyboard.type("Body cube")
        expect(desk.page.locator(".mantine-Spotlight-action").first).to_contain_text("Body cube")
        desk.page.keyboard.press("Enter")
        desk.tab("Inspect")
        expect(desk.page.get_by_text("centre of mass")).to_be_visible()
        desk.press("m")
        desk.shoot("hands")


def shoot_busy(browser: Browser) -> None:
    """An infinite loop in the reward of a new version."""
    lines = TASK.read_text().splitlines()
    place = next(i for i, line in enumerate(lines) if line.strip().startswith("def compute_dense_reward"))
    while not lines[place].rstrip().endswith(":"):
        place += 1
    lines[place + 1 : place + 1] = ["        while self.elapsed_steps.max() >= 0:", "            continue"]
    with live_page(browser, "--num-envs", "16") as desk:
        desk.step(25)
        desk.file.write_text("\n".join(lines) + "\n")
        expect(desk.page.get_by_role("button", name="Interrupt", exact=True)).to_be_visible(timeout=60_000)
        desk.press("t")
        desk.tab("Log")
        desk.shoot("busy")


# --- the review ---------------------------------------------------------------------------------------


def record(file: Path, folder: Path, *arguments: str) -> None:
    """Record episodes of the policy; recordings store its name as given here."""
    shutil.copy(POLICY, file.parent)
    command = [sys.executable, "-m", "workbench.cli.main", "record", file.name]
    command += ["--actions", f"{POLICY.name}:act", "--out", str(folder), *CONTROL, *arguments]
    subprocess.run(command, check=True, cwd=file.parent)


def shoot_review(browser: Browser) -> None:
    """The library; one episode; and one seed under two versions of the task, over each other."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(shutil.copy(TASK, Path(folder) / TASK.name))
        recordings = Path(folder) / "recordings"
        record(file, recordings, "--episodes", "8", "--num-envs", "8")
        file.write_text(TASK.read_text().replace("CUBE_HALF_SIZE = 0.02", "CUBE_HALF_SIZE = 0.025"))
        record(file, recordings, "--episodes", "2", "--num-envs", "8", "--no-pictures")
        with open_workbench(str(recordings), cwd=Path(folder), what="review") as opened:
            page, _ = new_page(browser, timeline=False)
            page.goto(opened.url)
            rows = page.locator(".wb-library").get_by_text(re.compile("seed0000"))
            expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
            close_notice(page)
            desk = Desk(page, file)
            # The newest recording is open, and in a narrow page the library is folded.
            time.sleep(FRAME_SECONDS)
            if not rows.first.is_visible():
                desk.press("b")
            expect(rows).to_have_count(2)
            rows.last.click()
            desk.shoot("library")
            desk.press("Enter")
            expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=60_000)
            if rows.first.is_visible():
                desk.press("b")
            for _ in range(2):
                desk.press("Shift+ArrowRight")
                time.sleep(1.0)
            desk.tab("Cameras")
            desk.shoot("review")
            if not rows.first.is_visible():
                desk.press("b")
            rows.first.click()
            page.keyboard.down("Control")
            rows.last.click()
            page.keyboard.up("Control")
            desk.press("Enter")
            desk.tab("Compare")
            expect(page.get_by_text(re.compile("They diverge at"))).to_be_visible(timeout=60_000)
            desk.press("End")
            desk.shoot("compare")
            page.close()


def shoot_sweep(browser: Browser) -> None:
    """Sizes of the cube and of the goal, each with the same seeds, and an episode of the best ones."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(shutil.copy(TASK, Path(folder) / TASK.name))
        shutil.copy(POLICY, folder)
        command = [sys.executable, "-m", "workbench.cli.main", "sweep", file.name, "--seeds", "8", *CONTROL]
        command += ["--set", "CUBE_HALF_SIZE=0.015,0.02,0.03", "--set", "GOAL_RADIUS=0.03,0.05,0.08"]
        command += ["--actions", f"{POLICY.name}:act", "--out", "sizes"]
        subprocess.run(command, check=True, cwd=folder)
        with open_workbench("sizes", cwd=Path(folder), what="review") as opened:
            page, _ = new_page(browser, timeline=False)
            page.goto(opened.url)
            expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
            close_notice(page)
            desk = Desk(page, file)
            time.sleep(FRAME_SECONDS)
            desk.tab("Sweep")
            page.locator(".wb-sweep-scroll tr[data-do]").first.click()
            page.locator(".wb-sweep-episodes tr[data-do]").first.click()
            time.sleep(FRAME_SECONDS)
            desk.press(*5 * ["ArrowRight"])
            desk.shoot("sweep")
            page.close()


def shoot_tutorial(browser: Browser) -> None:
    """The pictures of the tutorial: the live page after each step, then the recorded success."""
    with live_page(browser, "--num-envs", "8", task=text_after(1), name=FILE, checks=True) as desk:
        take_steps(desk)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        after(len(STEPS), folder)
        typed = next(fence for fence in STEPS[-1].fences if fence.language == "sh")
        (words,) = commands(typed)
        subprocess.run([sys.executable, "-m", "workbench.cli.main", *words[1:]], check=True, cwd=folder)
        with open_workbench("recordings", cwd=folder, what="review") as opened:
            page, _ = new_page(browser, timeline=False)
            page.goto(opened.url)
            expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
            close_notice(page)
            desk = Desk(page, folder / FILE)
            time.sleep(FRAME_SECONDS)
            desk.press(*10 * ["ArrowRight"])
            desk.tab("Cameras")
            desk.shoot("tutorial_recorded", kind="webp")
            page.close()


SHOTS: dict[str, Callable[[Browser], None]] = {
    "page": shoot_page,
    "reload": shoot_reload,
    "envs": shoot_envs,
    "studio": shoot_studio,
    "measured_camera": shoot_measured_camera,
    "branch": shoot_branch,
    "rescored": shoot_rescored,
    "hands": shoot_hands,
    "busy": shoot_busy,
    "checks": shoot_checks,
    "solve": shoot_solve,
    "review": shoot_review,
    "sweep": shoot_sweep,
    "tutorial": shoot_tutorial,
}
"""``page`` also takes run, cameras and banner, ``review`` also library and compare, ``tutorial`` all of the tutorial."""


def main(names: list[str]) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    unknown = set(names) - {*SHOTS, "demo"}
    if unknown:
        sys.exit(f"no such picture: {', '.join(sorted(unknown))}; there are {', '.join(SHOTS)} and demo")
    with_empty_settings()
    for name, shot in SHOTS.items():
        if not names or name in names:
            with browser_at(chromium) as browser:
                shot(browser)
    if not names or "demo" in names:
        with browser_at(chromium) as browser, live_page(browser, "--num-envs", "16", *CONTROL) as desk:
            take_policy(desk)
            take_film(desk, OUT / "demo.webp")


if __name__ == "__main__":
    main(sys.argv[1:])
