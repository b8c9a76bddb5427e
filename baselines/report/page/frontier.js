// The frontier of a table: its picture comes as a text, in which names are escaped; here it is put into the page.

function showFrontier(board) {
  const { svg, note } = board?.frontier ?? { svg: "", note: "" };
  const picture = svg ? new DOMParser().parseFromString(svg, "image/svg+xml").documentElement : null;
  byId("frontier").hidden = !picture;
  byId("frontier-picture").replaceChildren(...(picture ? [document.importNode(picture, true)] : []));
  byId("frontier-note").textContent = note;
}
