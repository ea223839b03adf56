// Choosing on a page: columns, rows and their order, order of views, axis of the curves, and a slider between two methods.
// The page is complete without it.
"use strict";

(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];

  function make(tag, properties = {}, ...children) {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  }

  // ---- Sorting of tables: best first, worst first, as written.

  function keyOf(row, index) {
    const cell = row.cells[index];
    if (cell.dataset.value !== undefined) return Number(cell.dataset.value);
    return cell.classList.contains("null") ? null : cell.textContent.trim();
  }

  function compareKeys(one, other) {
    if (typeof one === "number" && typeof other === "number") return one - other;
    return String(one).localeCompare(String(other), "en", { numeric: true });
  }

  function sortable(table) {
    const body = table.tBodies[0];
    const written = [...body.rows];
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, index) => {
      const button = make("button", { type: "button", className: "sort", title: "Sort" });
      button.append(...head.childNodes);
      head.append(button);
      const order = head.dataset.better === "higher" ? ["descending", "ascending"] : ["ascending", "descending"];
      button.addEventListener("click", () => {
        const next = order[order.indexOf(head.getAttribute("aria-sort")) + 1];
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        if (next === undefined) {
          body.append(...written);
          return;
        }
        head.setAttribute("aria-sort", next);
        const sign = next === "ascending" ? 1 : -1;
        const keys = new Map(written.map((row) => [row, keyOf(row, index)]));
        const known = written.filter((row) => keys.get(row) !== null);
        known.sort((one, other) => sign * compareKeys(keys.get(one), keys.get(other)));
        body.append(...known, ...written.filter((row) => keys.get(row) === null));
      });
    });
  }

  // ---- Rows of a long table that hold a text.

  function filterable(table) {
    const rows = [...table.tBodies[0].rows];
    if (rows.length < 16) return;
    const input = make("input", { type: "search" });
    const count = make("span");
    input.addEventListener("input", () => {
      const wanted = input.value.trim().toLowerCase();
      rows.forEach((row) => (row.hidden = !row.textContent.toLowerCase().includes(wanted)));
      count.textContent = wanted ? ` ${rows.filter((row) => !row.hidden).length} of ${rows.length}` : "";
    });
    table.parentElement.before(make("p", { className: "filter" }, make("label", {}, "Rows with ", input), count));
  }

  // ---- Choosing of columns, for all tables of metrics at once.

  function familyOf(table) {
    const kind = table.dataset.name.split("-")[0];
    return ["summary", "scene", "seeds"].includes(kind) ? "metrics" : kind;
  }

  function chooser(tables) {
    const titles = new Map();
    for (const head of tables.flatMap((table) => all("th[data-key]", table))) {
      const before = titles.get(head.dataset.key);
      const title = head.querySelector("button").firstChild.textContent;
      titles.set(head.dataset.key, { title, shown: !head.hidden || Boolean(before && before.shown) });
    }
    const boxes = make("div", { className: "boxes" });
    for (const [key, { title, shown }] of titles) {
      const box = make("input", { type: "checkbox", checked: shown, value: key });
      box.addEventListener("change", () => tables.forEach((table) => show(table, key, box.checked)));
      boxes.append(make("label", {}, box, ` ${title}`));
    }
    const folded = make("details", { className: "chooser" }, make("summary", {}, "Columns"), boxes);
    folded.dataset.family = familyOf(tables[0]);
    tables[0].parentElement.before(folded);
  }

  function show(table, key, shown) {
    const heads = [...table.tHead.rows[0].cells];
    const index = heads.findIndex((head) => head.dataset.key === key);
    if (index < 0) return;
    for (const row of table.rows) row.cells[index].hidden = !shown;
    const visible = new Set(heads.filter((head) => head.dataset.key && !head.hidden).map((head) => head.dataset.key));
    const below = table.parentElement.nextElementSibling;
    for (const note of below ? all("[data-columns]", below) : []) {
      note.hidden = !note.dataset.columns.split(" ").some((column) => visible.has(column));
    }
  }

  // ---- Curves against steps or seconds.

  function curveSwitch(fieldset) {
    const section = fieldset.closest("section");
    const choose = () => (section.dataset.curves = fieldset.querySelector("input:checked").value);
    fieldset.addEventListener("change", choose);
    fieldset.hidden = false;
    choose();
  }

  // ---- Slider between two methods.

  function comparator(box) {
    const views = all("article.frame");
    const choice = Object.fromEntries(all("[data-choice]", box).map((each) => [each.dataset.choice, each]));
    const stage = box.querySelector(".stage");
    const slider = box.querySelector("input");
    const [leftName, rightName] = all(".side", box);
    const methods = [...new Set(all("figure[data-method]").map((figure) => figure.dataset.method))];

    views.forEach((view, index) => choice.frame.append(make("option", { value: index }, view.dataset.title)));
    for (const side of [choice.left, choice.right]) {
      side.append(...methods.map((method) => make("option", { value: method }, method)));
    }
    const reference = methods.includes(box.dataset.reference) ? box.dataset.reference : methods[1];
    choice.left.value = reference;
    choice.right.value = methods.find((method) => method !== "truth" && method !== reference) || "truth";

    function place(image, method) {
      const figure = all("figure[data-method]", views[choice.frame.value]).find((each) => each.dataset.method === method);
      const source = figure && all("img", figure)[choice.kind.value];
      image.hidden = !source;
      if (!source) return `no such picture of ${method}`;
      image.src = source.getAttribute("src");
      image.alt = source.alt;
      const ratio = source.getAttribute("width") / source.getAttribute("height");
      stage.style.aspectRatio = String(ratio);
      box.style.setProperty("--ratio", String(ratio));
      return "";
    }

    function update() {
      const missing = [
        place(stage.querySelector(".left"), choice.left.value),
        place(stage.querySelector(".right"), choice.right.value),
      ].filter(Boolean);
      all(".note", stage).forEach((note) => note.remove());
      if (missing.length) stage.append(make("div", { className: "note" }, missing.join("; ")));
      leftName.textContent = choice.left.value;
      rightName.textContent = choice.right.value;
    }

    function slide() {
      stage.style.setProperty("--at", `${slider.value}%`);
      slider.setAttribute("aria-valuetext", `${slider.value} % ${choice.left.value}`);
    }

    function follow(event) {
      const { left, width } = stage.getBoundingClientRect();
      slider.value = String((100 * (event.clientX - left)) / width);
      slide();
    }

    Object.values(choice).forEach((select) => select.addEventListener("change", () => (update(), slide())));
    slider.addEventListener("input", slide);
    stage.addEventListener("pointerdown", (event) => {
      stage.setPointerCapture(event.pointerId);
      follow(event);
    });
    stage.addEventListener("pointermove", (event) => {
      if (stage.hasPointerCapture(event.pointerId)) follow(event);
    });
    views.forEach((view, index) => {
      const button = make("button", { type: "button", className: "show-above" }, "compare above");
      button.addEventListener("click", () => {
        choice.frame.value = String(index);
        update();
        box.scrollIntoView({ block: "nearest" });
        slider.focus();
      });
      view.querySelector("h4").append(button);
    });
    box.hidden = false;
    update();
    slide();
  }

  // ---- Scenes are loaded once they are opened.

  function scene(details) {
    const frame = details.querySelector("iframe");
    details.addEventListener("toggle", () => (frame.srcdoc ||= frame.dataset.page));
  }

  // ---- One of several scenes.

  function scenes(box) {
    const select = box.querySelector("select"), frames = [...box.querySelectorAll("iframe")];
    function show(index) {
      frames.forEach((frame, own) => (frame.hidden = own !== index));
      const { page, file } = frames[index].dataset;
      if (page === undefined) frames[index].src ||= file;
      else frames[index].srcdoc ||= page;
    }
    if (select) select.addEventListener("change", () => show(select.selectedIndex));
    show(0);
  }

  // ---- What is pointed at on a time line.

  function readout(line) {
    const told = line.querySelector(".readout");
    const tell = (event) => (told.textContent = event.target.closest("[title]")?.title ?? told.textContent);
    for (const kind of ["pointerover", "focusin"]) line.addEventListener(kind, tell);
  }

  const tables = all("table.results");
  tables.forEach(sortable);
  tables.forEach(filterable);
  for (const family of new Set(tables.map(familyOf))) {
    const own = tables.filter((table) => familyOf(table) === family);
    if (own.some((table) => table.querySelector("th[hidden]"))) chooser(own);
  }
  all("[data-switch=curves]").forEach(curveSwitch);
  all(".compare").forEach(comparator);
  all("details.scene").forEach(scene);
  all(".scenes").forEach(scenes);
  all(".timeline").forEach(readout);
})();
