// The workspace that the page lies in, or that `hineus view` shows; else a name to fill in.
async function findWorkspace() {
  if (location.protocol === "file:") {
    const found = decodeURIComponent(location.pathname).match(/^(.+)\/report\/report\.html$/);
    return found ? found[1] : "WORKSPACE";
  }
  try {
    return (await (await fetch("/state.json")).json()).workspace || "WORKSPACE";
  } catch {
    return "WORKSPACE";
  }
}

function shellWord(word) {
  return /^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", `'"'"'`)}'`;
}

// The commands beside warnings name it.
findWorkspace().then((workspace) => {
  for (const command of document.querySelectorAll(".warning pre")) {
    command.textContent = command.textContent.replace("--workspace WORKSPACE", `--workspace ${shellWord(workspace)}`);
  }
});
