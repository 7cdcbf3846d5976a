// Above each group of views, a slider that compares any two images of one view.
// Without this script the images are side by side.
"use strict";
for (const group of document.querySelectorAll(".compare")) {
  const views = [...group.querySelectorAll(".view")];
  const kinds = [];
  for (const image of group.querySelectorAll("figure"))
    if (!kinds.includes(image.dataset.kind)) kinds.push(image.dataset.kind);
  if (views.length && kinds.length > 1) enhance(group, views, kinds);
}

function enhance(group, views, kinds) {
  const stage = document.createElement("div");
  stage.className = "stage";
  stage.innerHTML = `
    <div class="picks">
      <label>left <select class="pick-left"></select></label>
      <label>right <select class="pick-right"></select></label>
      <span class="spring"></span>
      <label>view <select class="pick-view"></select></label>
    </div>
    <div class="slider">
      <img class="under" alt=""><img class="over" alt="">
      <span class="tag left"></span><span class="tag right"></span>
      <div class="handle"></div>
      <input type="range" min="0" max="100" step="0.5" value="50">
    </div>`;
  const find = (name) => stage.querySelector(name);
  const [left, right, view] = [".pick-left", ".pick-right", ".pick-view"].map(find);
  const [slider, range] = [".slider", "input"].map(find);
  for (const kind of kinds) for (const pick of [left, right]) pick.add(new Option(kind));
  views.forEach((one, i) => view.add(new Option(one.dataset.name, i)));
  left.value = group.dataset.left;
  right.value = group.dataset.right;
  view.value = Math.max(views.findIndex((one) => one.dataset.name === group.dataset.first), 0);

  const move = () => {
    slider.style.setProperty("--at", range.value + "%");
    range.setAttribute("aria-valuetext", `${Math.round(range.value)} % ${left.value}`);
  };
  const show = () => {
    const chosen = views[view.value];
    const image = (kind) => chosen.querySelector(`[data-kind="${CSS.escape(kind)}"] img`);
    const put = (image, from, kind, tag) => {
      if (from) { image.src = from.src; image.alt = from.alt; }
      image.style.visibility = from ? "" : "hidden";
      tag.textContent = from ? kind : kind + " (none)";
    };
    put(find(".over"), image(left.value), left.value, find(".tag.left"));
    put(find(".under"), image(right.value), right.value, find(".tag.right"));
    range.setAttribute("aria-label", `Compare ${left.value} and ${right.value}`);
    for (const one of views) one.classList.toggle("chosen", one === chosen);
    move();
  };
  range.addEventListener("input", move);
  for (const pick of [left, right, view]) pick.addEventListener("change", show);
  views.forEach((one, i) => one.addEventListener("click", () => { view.value = i; show(); }));
  group.prepend(stage);
  group.classList.add("enhanced");
  show();
}
