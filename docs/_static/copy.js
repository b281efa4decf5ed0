// A button on each block of commands or code; comments and prompts of examples are copied as they stand.
document.addEventListener("DOMContentLoaded", () => {
  if (!navigator.clipboard) return;  // a page from a disk, in some browsers
  for (const block of document.querySelectorAll("div.highlight")) {
    const button = document.createElement("button");
    button.className = "copy";
    button.type = "button";
    button.textContent = "copy";
    const code = block.querySelector("pre"), text = code.innerText.replace(/\n$/, "");
    button.onclick = async () => {
      await navigator.clipboard.writeText(text);
      button.textContent = "copied";
      setTimeout(() => { button.textContent = "copy"; }, 1500);
    };
    code.prepend(button);
  }
});
