"""Finds layout defects, by functions in JavaScript: text that is cut off or covered, buttons that touch, tabs in two rows."""

FAULTS = r"""() => {
    const faults = new Set();
    const EDGE = 1.5, APART = 3;
    const name = (element) => (element.innerText || element.value || element.className || element.tagName).trim().replace(/\s+/g, " ").slice(0, 60);
    const styles = new Map();
    const style = (element) => styles.get(element) ?? styles.set(element, getComputedStyle(element)).get(element);

    // What of a rectangle is seen, and whether the rest of it can be scrolled to.
    function seen(element, rect) {
        let [left, top, right, bottom] = [rect.left, rect.top, rect.right, rect.bottom], cut = false;
        for (let at = element; at && at !== document.body; at = at.parentElement) {
            const { overflowX, overflowY, position } = style(at);
            if (overflowX !== "visible" || overflowY !== "visible") {
                const box = at.getBoundingClientRect();
                if (overflowX !== "visible") {
                    if ((overflowX === "hidden" || overflowX === "clip") && (right > box.right + EDGE || left < box.left - EDGE)) cut = true;
                    left = Math.max(left, box.left); right = Math.min(right, box.right);
                }
                if (overflowY !== "visible") {
                    top = Math.max(top, box.top); bottom = Math.min(bottom, box.bottom);
                }
            }
            if (position === "fixed") break;
        }
        left = Math.max(left, 0); top = Math.max(top, 0); right = Math.min(right, innerWidth); bottom = Math.min(bottom, innerHeight);
        return { left, top, right, bottom, cut, shown: right - left > 1 && bottom - top > 1 };
    }
    const overlap = (a, b, by = 0) => a.left < b.right + by && b.left < a.right + by && a.top < b.bottom + by && b.top < a.bottom + by;
    const visible = (element) => element.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true });
    const inView = (element) => element.closest("[data-dock-root]")?.firstElementChild.contains(element);
    const panelOf = (element) => element.closest("[data-floating-window], [data-dock-region]");

    // Texts, line by line.
    const texts = [];
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node; (node = walk.nextNode()); ) {
        const element = node.parentElement;
        if (!node.nodeValue.trim() || element.closest("script, style, svg, .mantine-Notification-root") || !visible(element) || inView(element)) continue;
        const range = document.createRange();
        range.selectNodeContents(node);
        for (const rect of range.getClientRects()) {
            if (rect.width < 1) continue;
            const part = seen(element, rect);
            if (!part.shown) continue;
            let ellipsis = null;
            for (let at = element; at && !ellipsis && at !== document.body; at = at.parentElement)
                if (style(at).textOverflow === "ellipsis" && at.scrollWidth > at.clientWidth) ellipsis = at;
            if (ellipsis && !ellipsis.closest("[title]")) faults.add(`shortened, and no tooltip has the whole: ${name(element)}`);
            if (part.cut && !ellipsis) faults.add(`cut: ${node.nodeValue.trim().slice(0, 60)}`);
            texts.push({ element, ...part, text: node.nodeValue.trim().slice(0, 40) });
        }
    }
    // A panel that hides another is a fault of its own; within one no text lies on another.
    for (let i = 0; i < texts.length; i++)
        for (let j = i + 1; j < texts.length; j++) {
            const a = texts[i], b = texts[j];
            if (a.element === b.element || a.element.contains(b.element) || b.element.contains(a.element)) continue;
            if (panelOf(a.element) === panelOf(b.element) && overlap(a, b, -3) && !a.element.closest(".mantine-Select-dropdown") && !b.element.closest(".mantine-Select-dropdown"))
                // What is sticky lies over what is scrolled under it.
                if (onTop(a) && onTop(b)) faults.add(`on each other: ${a.text} | ${b.text}`);
        }
    function onTop(part) {
        const found = document.elementFromPoint((part.left + part.right) / 2, (part.top + part.bottom) / 2);
        return found && (found.contains(part.element) || part.element.contains(found));
    }

    // Buttons.
    const buttons = [...document.querySelectorAll(".mantine-Button-root, .wb-pill, .wb-button, .wb-rules-mark, .wb-tag[data-do]")]
        .filter((element) => visible(element) && !inView(element) && !element.closest(".mantine-Notification-root"))
        .map((element) => ({ element, box: element.getBoundingClientRect(), ...seen(element, element.getBoundingClientRect()) }))
        .filter((one) => one.shown);
    buttons.forEach((a, i) => {
        for (const b of buttons.slice(i + 1))
            if (panelOf(a.element) === panelOf(b.element) && overlap(a, b, APART - 0.5)) faults.add(`buttons touch: ${name(a.element)} | ${name(b.element)}`);
        const range = document.createRange();
        range.selectNodeContents(a.element);
        const text = range.getBoundingClientRect();
        if (text.width && (text.left < a.box.left + 3 || text.right > a.box.right - 3)) faults.add(`text over a button's edge: ${name(a.element)}`);
    });

    // Scroll bars over text.
    for (const bar of document.querySelectorAll(".mantine-ScrollArea-scrollbar")) {
        if (!visible(bar) || style(bar).opacity === "0") continue;
        const box = seen(bar, bar.getBoundingClientRect());
        if (!box.shown) continue;
        for (const text of texts)
            if (panelOf(text.element) === panelOf(bar) && overlap(text, box, -1) && onTop({ ...text }) !== null)
                faults.add(`a scroll bar lies over: ${text.text}`);
    }

    // Panels.
    const panels = [...document.querySelectorAll("[data-floating-window], [data-dock-region]")].filter(visible);
    panels.forEach((a, i) => {
        const box = a.getBoundingClientRect();
        if (box.left < -1 || box.top < -1 || box.right > innerWidth + 1 || box.bottom > innerHeight + 1) faults.add(`off the page: ${name(a)}`);
        for (const b of panels.slice(i + 1)) if (overlap(box, b.getBoundingClientRect(), -1)) faults.add(`panels on each other: ${name(a)} | ${name(b)}`);
    });
    return [...faults].sort();
}"""
"""Returns a line for each layout defect on the page."""
TAB_ROWS = "() => new Set([...document.querySelectorAll('[data-dock-region=right] [role=tab]')].map(e => e.offsetTop)).size"
"""Returns the number of rows of tabs in the right dock."""
FIELD_FONTS = """() => [...document.querySelectorAll('[data-dock-region=right] .wb-field > :is(span, input[type=text], select)')]
    .filter(e => e.checkVisibility()).map(e => getComputedStyle(e)).map(s => [s.fontSize, s.fontFamily, s.letterSpacing].join())"""
"""Returns the font of each visible label and input in the right dock."""
