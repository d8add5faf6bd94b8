// Photos of one's own: chosen, or dropped anywhere, one or several or a folder; they are sent one after the other.

import { find } from "./dom.js";

const MOST_OWN = 200; // photos of one tab
const PICTURE = /\.(jpe?g|png|webp)$/i;

export class OwnSender {
  /**
   * @param {{sendFile: (file: File, first: boolean) => Promise<void>}} channel
   * @param {(text: string, busy: boolean) => void} say
   */
  constructor(channel, say) {
    this.channel = channel;
    this.say = say;
    /** @type {File[]} */
    this.queue = [];
    this.taken = 0;
    /** @type {((taken: boolean) => void) | null} */
    this.waiting = null;
    this.listen();
  }

  /** Choose photos, or a folder of them. */
  choose(folder = false) {
    const input = find("#file");
    input.webkitdirectory = folder;
    input.click();
  }

  /** The server has taken or left out so many files until now. */
  received(taken) {
    const more = taken > this.taken;
    this.taken = taken;
    if (more) this.waiting?.(true);
  }

  /** The connection is lost, and with it what the server held. */
  lost() {
    this.queue = [];
    this.taken = 0;
    this.waiting?.(false);
  }

  async send(files) {
    const running = this.queue.length > 0;
    this.queue.push(...files.slice(0, MOST_OWN));
    if (running || !this.queue.length) return;
    const whole = this.queue;
    let unread = "";
    for (let at = 0; this.queue === whole && at < whole.length; at++) {
      this.say(whole.length > 1 ? `Reading photo ${at + 1} of ${whole.length}` : "Reading your photo", true);
      const answered = new Promise((done) => (this.waiting = done));
      try {
        await this.channel.sendFile(whole[at], at === 0);
        await answered;
      } catch {
        unread = whole[at].name; // it was moved, or may not be read
      }
    }
    if (this.queue !== whole) return; // the connection was lost
    this.queue = [];
    this.say(unread && `${unread} cannot be read; choose it again.`, !unread);
  }

  listen() {
    find("#file").addEventListener("change", (event) => {
      const files = [...event.target.files];
      this.send(event.target.webkitdirectory ? files.filter((file) => PICTURE.test(file.name)) : files);
      event.target.value = "";
    });
    addEventListener("dragover", (event) => {
      event.preventDefault();
      document.body.classList.add("drop");
    });
    addEventListener("dragleave", (event) => {
      if (!event.relatedTarget) document.body.classList.remove("drop");
    });
    addEventListener("drop", async (event) => {
      event.preventDefault();
      document.body.classList.remove("drop");
      const items = [...(event.dataTransfer?.items ?? [])].filter((item) => item.kind === "file");
      const entries = items.map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile()); // they are gone after an await
      this.send((await Promise.all(entries.map((entry) => filesOf(entry, true)))).flat());
    });
  }
}

/** @returns {Promise<File[]>} the file of a dropped entry, or the pictures in a folder and its folders */
const filesOf = async (entry, named = false) => {
  if (!entry) return [];
  if (entry instanceof File) return [entry];
  if (entry.isFile) return named || PICTURE.test(entry.name) ? [await new Promise((done, fail) => entry.file(done, fail))] : [];
  const reader = entry.createReader();
  const files = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length || files.length >= MOST_OWN) return files;
    for (const one of some) files.push(...(await filesOf(one)));
  }
};
