// Listens to a running program: each message is what has changed since the last, and the words of the moment.
const strips = new Map();
const kept = 300;  // numbers of a plot
const told = {};
function changed(name, value) {
  const text = JSON.stringify(value);
  if (told[name] === text) { return false; }
  told[name] = text;
  return true;
}
function listen() {
  const wire = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/wire`);
  let begun = false;
  wire.onmessage = ({ data }) => {
    begun = true;
    const { page, commands } = JSON.parse(data);
    handle(commands);
    for (const part of off) { find(part).visible = false; }
    const { title, outcome, good, facts, legend } = page;
    if (changed("words", { title, outcome, good, facts, legend })) { words(page); }
    rows(element("now"), page.now).forEach((cell, row) => { cell.className = page.now[row][2] ? "alarm" : ""; });
    element("moment").style.display = page.now.length ? "" : "none";
    element("clock").textContent = page.clock;
    for (const row of page.plots) {
      if (!strips.has(row.name)) { strips.set(row.name, { ...plot(row), values: [] }); }
      const strip = strips.get(row.name);
      strip.values = [...strip.values, row.now].slice(-kept);
      strip.fill(strip.values, strip.values.map((_, k) => k));
      strip.at(1, row.now);
    }
    if (changed("labels", page.labels)) { name(page.labels); }
    const wider = changed("corners", page.corners), other = changed("views", page.views);
    if (wider) { bounds(page.corners); }
    if (other) {
      const present = view && view.name;
      offer(page.views);
      view = VIEWS[present] || VIEWS[page.views[0].name];
    }
    if (wider || other) { arrange(); }
  };
  wire.onclose = () => {
    if (begun) { element("clock").textContent = `${element("clock").textContent.replace(/ \(ended\)$/, "")} (ended)`; }
    setTimeout(again, 2000);
  };
}
function again() {  // the program may be started anew, or this machine may have slept
  const wire = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/wire`);
  wire.onopen = () => location.reload();
  wire.onclose = () => setTimeout(again, 2000);
}
element("clock").style.display = "";
listen();
