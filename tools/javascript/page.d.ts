// The types of what the page's scripts share, which `make check` reads. The page never loads this file.

// Right and down in pixels, or east and north in metres.
type Point = number[];
// 9 numbers by rows.
type Homography = number[];
interface Box { left: number; top: number; right: number; bottom: number }
// Names in the style sheets and the templates, or a box on the stage: west, south, east, north.
interface Place { selectors: string[]; box: number[] | null }
interface Step { caption: string; notes: string; points_at: string; shows: string }
interface Story { name: string; steps: Step[] }
interface Ground { through: boolean; middle: Point; metres: number; degrees: Point[] | null }

// What a map shows: the middle in its plane, and pixels per unit.
interface View { x: number; y: number; scale: number }
interface PanZoom {
  view: View | null;
  size(): [number, number];
  toPixels(at: Point): [number, number];
  toPlane(at: Point): Point;
  // Show from the lower left to the upper right corner in a share of the map; no side of them counts as shorter than `least`.
  fit(low: Point, high: Point, share: number, least: number): void;
  zoom(factor: number, at?: Point): void;
  stepIn(): void;
  stepOut(): void;
  key(event: KeyboardEvent): boolean; // true if the key is one of the map's
}
interface PanZoomOptions {
  limits(): [number, number]; // of pixels per unit
  bounds(): number[]; // west, south, east, north: some of it stays in sight
  ready(): boolean; // whether there is a view
  changed(): void; // the person has moved the map
  home(): void; // show all
  pointed?(at: Point, event: MouseEvent, pressed?: boolean): void; // the pointer is at a place
  tapped?(at: Point, event: PointerEvent): boolean; // a press without a drag; true if it was on something
  pen?: { down(at: Point, event: PointerEvent): boolean; move(at: Point): void; up(): void; cancel(): void }; // true: it takes the drag
  ignores?: string; // selectors of what lies on the map
}

interface Lpn {
  // Set by the server when it installs the script, see `PageBridge`.
  bridge: string;
  keys: string[];
  title: string;
  ownHint: string;
  noLink: string;
  tour: Story;
  scene: { width: number; height: number; middle: Point };
  places: Record<string, Place>;

  // page.js
  canvas(): HTMLCanvasElement | null;
  clamp(value: number, low: number, high: number): number;
  stored(storage: "local" | "session", key: string): string | null | undefined;
  store(storage: "local" | "session", key: string, text: string | null): void;
  send(kind: string, value?: unknown): void;
  resume(): [string, unknown][];
  begins(): boolean;
  holdMessages(): void;
  mouse: Point;
  cell(map: HTMLElement, event: MouseEvent): number;
  hover(map: HTMLElement, event: MouseEvent, held?: boolean): void;
  leave(map: HTMLElement): void;
  hold(map: HTMLElement, event: MouseEvent): void;
  value(map: HTMLImageElement, event: MouseEvent): void;
  stroke(map: HTMLElement & { _painted: Set<number> | null; _erase: boolean }, event: PointerEvent): void;
  typed(box: HTMLInputElement & { _timer: number }, kind: string): void;
  entered(box: HTMLInputElement, event: KeyboardEvent, kind: string): void;
  tip(tip: HTMLElement): void;

  // viser_compat.js
  viser: {
    SELECTORS: Record<
      | "app" | "canvas" | "stageFrame" | "shade" | "window" | "folderHead" | "unfolded" | "sheet" | "sheetHead" | "sheetParts" | "scrollRoot" | "scrolled" | "dialog"
      | "dialogTitle" | "dialogHeader" | "dialogBody" | "dialogButton" | "palette" | "notification" | "notificationText" | "softwareNotice" | "upload" | "tab" | "left" | "leftOpen",
      string
    >;
    UPLOADED: string;
    EXPAND: string;
    FOLDED: string;
    SCHEME: string;
    mend(): void;
    onRetry(tries: (goOn: () => void) => void): void;
    field(uuid: string): HTMLInputElement | null;
    camera(): any;
    cameraControls(): any;
    sendCamera(): void;
    draw(): void;
    axes(): number[] | undefined;
    shaded(): boolean | null;
  };
  onChange(period: number, look: () => void): () => void;
  every(period: number, look: () => void): number;

  // viewport.js
  head(html: string): void;
  say(text: string, seconds?: number): void;
  work(done: number, total: number): void;
  openingSize(): number[] | null;
  docked?: boolean; // there are panels beside the stage
  greeted: number;
  settled(act: () => void): void;
  isHere: boolean;
  named(text: string): string;
  focus(uuid: string): void;
  small: MediaQueryList;
  stageSize(): Point | null;
  stage(html: string): void;
  placeStage(): void;
  folded(): boolean;
  watch(): void;
  unfoldSheet(): void;
  fill(name: string, texts: Record<string, string>): void;
  reveal(selector: string): void;
  tab(name: string, tries?: number): void;
  once(key: string): boolean;

  // focus.js
  refocus(element: HTMLElement | null): void;
  lastFocus(): HTMLElement | null;
  raise(element: HTMLElement | null): void;
  revealReasons(): void;
  raiseReasons(): void;

  // Panels and windows, each in a file of its name.
  glossary: { open(): boolean };
  backClosesGlossary(): boolean;
  enlargeable(picture: HTMLImageElement): void;
  backClosesPicture(): boolean;
  pins(page: HTMLElement, query: string | undefined): void;
  straighten(): void;
  list(id: string, data: any, tries?: number): void;
  note(element: HTMLElement): void;
  noteTyped(box: HTMLElement): void;
  noteOpened(path: string): void;
  noteStored(path: string, texts: string[]): void;
  own: { go(number: number, total: number): Promise<void>; folder(): void; take(files: any[], beyond?: number): unknown };
  upload(): void;
  point(card: HTMLElement | null, name?: string): void;
  leaveFirst(): void;
  screen(): "" | "first" | "all";
  opening(): void;
  unopened(reason: string, goesOn?: boolean): void;
  firstAgain(): unknown;
  comparing(text: string): void;
  offer(): void;
  northUp(link: HTMLElement): void;
  preview(html: string): void;
  first(html: string, free: boolean, unasked: boolean): void;
  hideTip(): void;
  stageMap(ground: Ground | null): void;
  stopFlying(): void;
  clearStage(): void;
  stagePhoto: { (photo: { source: string; aspect: number; flips: number } | null): void; on(): boolean };

  // Maps and their drawing.
  panZoom(element: HTMLElement, options: PanZoomOptions): PanZoom;
  pictureLoader(redraw: () => void, kept: number): {
    image(address: string): HTMLImageElement | null;
    request(addresses: string[]): void;
    clear(): void;
  };
  tiles(redraw: () => void): { draw(pen: CanvasRenderingContext2D, ratio: number, data: any, map: PanZoom): number; clear(): void };
  thumbnails(redraw: () => void): { all(addresses: string[]): (HTMLImageElement | null)[] };
  colour(name: string, kind?: "raw" | "mark"): string;
  pens: {
    canvas(element: HTMLCanvasElement): [CanvasRenderingContext2D, number];
    stroke(pen: CanvasRenderingContext2D, colour: string, width: number, dash?: number[]): void;
    dot(pen: CanvasRenderingContext2D, at: Point, radius: number, colour: string, hollow: boolean): void;
    diamond(pen: CanvasRenderingContext2D, at: Point, radius: number, colour: string): void;
    text(pen: CanvasRenderingContext2D, words: string, left: number, top: number, align?: CanvasTextAlign): void;
  };
  mapMarks: {
    bar(pen: CanvasRenderingContext2D, at: Point, scale: number, width: number): number;
    north(pen: CanvasRenderingContext2D, at: Point, turn?: number): void;
    degrees(at: Point): string;
    metres(at: Point): string;
  };
  labMap: { (next: any, tries?: number): void; pixels(i: number): Point };
  through(h: Homography, at: Point): Point;
  homography(from: Point[], to: Point[]): Homography | null;
  product(one: Homography, other: Homography): Homography;
  transform(h: Homography): string;
  flight: any;

  // stories.js and url_state.js
  tell(story: Story, first?: number): void;
  telling(): boolean;
  welcome(unasked: boolean): void;
  storyAddress(): "replaceState" | "pushState" | null;
  backEndsStory(): boolean;
  backQuietly(): void;
  keepTheme(name: string): void;
  themed(name: string): void;
  keepWords(name: string): void;
  tellWords(): void;
  linked: boolean;
  greet(): void;
  address(query: string, keys: string[]): void;
  copy(): Promise<void>;
  copyText(id: string): Promise<void>;
  look: string | null;
}

interface Window {
  lpn: Lpn;
  lpnWay: { look(): Promise<string>; theme(search: string): "light" | "dark" };
  // Of viser.
  __viserMutable: any;
  __viserSceneTree: any;
}

// The page has elements of HTML only, and its events happen to them, or to the document or the window, which lack these functions.
interface ParentNode {
  querySelector<K extends keyof HTMLElementTagNameMap>(selectors: K): HTMLElementTagNameMap[K] | null;
  querySelector<E extends Element = HTMLElement>(selectors: string): E | null;
  querySelectorAll<K extends keyof HTMLElementTagNameMap>(selectors: K): NodeListOf<HTMLElementTagNameMap[K]>;
  querySelectorAll<E extends Element = HTMLElement>(selectors: string): NodeListOf<E>;
}
interface Element {
  closest<E extends Element = HTMLElement>(selectors: string): E | null;
}
interface EventTarget {
  closest?<E extends Element = HTMLElement>(selectors: string): E | null;
  matches?: any; // a boolean where the target is a media query
  click?(): void;
}
