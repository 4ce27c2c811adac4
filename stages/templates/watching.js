  const element = (id) => document.getElementById(id);
  const make = (tag, text, more) => Object.assign(document.createElement(tag), { textContent: text }, more);
  const drawn = (svg) => document.importNode(new DOMParser().parseFromString(svg, "text/html").body.firstChild, true);
  const items = (stages) => stages.map((stage) => make("li", stage.name, { className: stage.state, title: stage.summary }));
  // Draws the state every other second, until it is that of another page.
  const follow = (draw, isOfAnother) => {
    const ask = async () => {
      try {
        const state = await (await fetch("state.json")).json();
        if (isOfAnother(state)) return location.replace("./");
        draw(state);
        document.documentElement.dataset.live = "ready";
      } catch {
        element("said").textContent = "`hineus view` has ended.";
      }
      setTimeout(ask, 2000);
    };
    ask();
  };
