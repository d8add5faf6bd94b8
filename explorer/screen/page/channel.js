// The channel to the server: JSON over one websocket. The page sends `set` or `do`, and gets values by their kinds.

const PART = 512 * 1024;
const AGAIN = 2000; // ms
const MOST = 30_000_000; // bytes of a photo

/** The name of this tab; the server finds its scene by it. */
export const tab = [...crypto.getRandomValues(new Uint8Array(8))].map((one) => one.toString(16).padStart(2, "0")).join("");

/**
 * Connect, and connect again whenever the connection is lost.
 * @param {Record<string, (value: any) => void>} receive handlers by the kind of message
 * @param {() => void} opened
 * @param {() => void} lost
 */
export const connect = (receive, opened, lost) => {
  let socket = null;
  const open = () => {
    const folder = new URL("./", location.href).href.replace(/^http/, "ws");
    socket = new WebSocket(`${folder}api/${tab}`, "lpn-json");
    socket.onopen = opened;
    socket.onmessage = (event) => {
      for (const [kind, value] of Object.entries(JSON.parse(event.data))) receive[kind]?.(value);
    };
    socket.onclose = () => {
      lost();
      setTimeout(open, AGAIN);
    };
  };
  const sendRaw = (data) => {
    if (socket?.readyState === WebSocket.OPEN) socket.send(data);
  };
  const send = (message) => sendRaw(JSON.stringify(message));
  open();
  return {
    set: (values) => send({ set: values }),
    act: (name, args = {}) => send({ do: name, args }),
    /** Send a file in parts; fails for an unreadable file. The server refuses a too large one by its size alone. */
    sendFile: async (file, first) => {
      send({ do: "upload", args: { name: file.name, size: file.size, first } });
      for (let start = 0; start < file.size && file.size <= MOST; start += PART) {
        sendRaw(await file.slice(start, start + PART).arrayBuffer());
      }
    },
  };
};
