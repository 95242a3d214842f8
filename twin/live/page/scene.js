// The instrument in three dimensions; bodies move as the state says, times a factor.
const byId = (id) => document.getElementById(id);
const LARGEST = 1e7; // factor at the slider's end
const FIRST = 1e5;
const SLOW = 12; // ms of a drawing from which it is slow
const REST = 300; // ms without a change after which a slow one is made
const LATEST = 2000; // ms after which it is made all the same
const DISTANCE = 0.86; // of the eye, in sizes of the instrument, from where all of it is seen
const TURN = 0.12; // radians an arrow key turns the view by

// none, or what draws: a graphics card, or the processor in its place
const graphics = () => {
  try {
    const context = document.createElement('canvas').getContext('webgl2');
    if (!context) return null;
    const told = context.getExtension('WEBGL_debug_renderer_info');
    const name = String(told ? context.getParameter(told.UNMASKED_RENDERER_WEBGL) : '');
    context.getExtension('WEBGL_lose_context')?.loseContext();
    return /swiftshader|llvmpipe|software|basic render/i.test(name) ? 'processor' : 'card';
  } catch {
    return null;
  }
};

export class Scene {
  constructor(root) {
    this.root = root;
    this.nodes = new Map();
    this.motions = {};
    this.ready = null;
    byId('factor').addEventListener('input', () => this.place(this.motions));
    byId('factor').value = Math.round((1000 * Math.log(FIRST)) / Math.log(LARGEST));
    byId('light').addEventListener('change', () => {
      for (const beam of this.beams ?? []) beam.visible = byId('light').checked;
      this.draw();
    });
    byId('home').addEventListener('click', () => this.home());
    root.addEventListener('keydown', (event) => this.key(event));
  }

  async load() {
    const kind = typeof THREE === 'undefined' ? null : graphics();
    if (!kind) {
      this.root.textContent = 'This browser cannot show the 3-D view (WebGL 2 is missing).';
      return;
    }
    if (!this.renderer) this.start(kind);
    const answer = await fetch('scene.glb');
    const gltf = await new THREE.GLTFLoader().parseAsync(await answer.arrayBuffer(), '');
    if (this.model) this.world.remove(this.model);
    this.model = gltf.scene;
    this.world.add(this.model);
    this.nodes = new Map();
    this.beams = [];
    this.model.traverse((node) => {
      const name = node.userData.name ?? node.name;
      if (name.startsWith('light/')) this.beams.push(node);
      if (node.isMesh) {
        node.material = node.material.clone();
        node.material.metalness = 0; // without surroundings to reflect, metal is black
        node.userData.colour = node.material.color.getHex();
      }
      this.nodes.set(name, { node, nominal: node.matrix.clone() });
    });
    for (const { node, nominal } of this.nodes.values()) {
      node.updateMatrix();
      nominal.copy(node.matrix);
      node.matrixAutoUpdate = false;
    }
    this.model.updateMatrixWorld(true);
    const box = new THREE.Box3();
    this.model.traverse((node) => { if (node.isMesh && !this.beams.includes(node)) box.expandByObject(node); });
    this.size = box.getSize(new THREE.Vector3()).length();
    this.middle = box.getCenter(new THREE.Vector3());
    this.camera.near = 0.001 * this.size;
    this.camera.far = 20 * this.size;
    this.resize();
    this.home();
    this.place(this.motions);
    this.root.dataset.ready = 'yes';
  }

  start(kind) {
    // the processor has the spots to compute
    const card = kind === 'card';
    this.card = card;
    this.pixel = new Uint8Array(4);
    this.renderer = new THREE.WebGLRenderer({ antialias: card, alpha: true });
    this.renderer.setPixelRatio(card ? Math.min(devicePixelRatio, 2) : 1);
    this.root.replaceChildren(this.renderer.domElement);
    this.world = new THREE.Scene();
    this.world.add(new THREE.HemisphereLight(0xffffff, 0x8890a0, 2.4));
    for (const [x, y, z, strength] of [[2, -3, 4, 2.2], [-4, 2, -1, 1.0]]) {
      const lamp = new THREE.DirectionalLight(0xffffff, strength);
      lamp.position.set(x, y, z);
      this.world.add(lamp);
    }
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.01, 100);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener('change', () => this.draw());
    new ResizeObserver(() => this.resize()).observe(this.root);
  }

  home() {
    if (!this.model) return;
    const wide = Math.max(1, 1.25 / this.camera.aspect);
    this.camera.position.copy(this.middle).add(new THREE.Vector3(0.35, -1.15, 0.55).multiplyScalar(DISTANCE * this.size * wide));
    this.controls.target.copy(this.middle);
    this.controls.update();
    this.draw();
  }

  key(event) {
    const turns = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, TURN], ArrowDown: [0, -TURN] }[event.key];
    const zoom = { '+': 0.85, '-': 1 / 0.85 }[event.key];
    if (!this.model || (!turns && !zoom)) return;
    event.preventDefault();
    const arm = this.camera.position.clone().sub(this.controls.target);
    if (zoom) arm.multiplyScalar(zoom);
    if (turns) {
      const radius = arm.length();
      const around = Math.atan2(arm.y, arm.x) + turns[0];
      const up = Math.max(-1.5, Math.min(1.5, Math.asin(arm.z / radius) + turns[1]));
      arm.set(radius * Math.cos(up) * Math.cos(around), radius * Math.cos(up) * Math.sin(around), radius * Math.sin(up));
    }
    this.camera.position.copy(this.controls.target).add(arm);
    this.controls.update();
    this.draw();
  }

  // k times the motion: nominal . (turn by k about the pivot, shift by k)
  place(motions) {
    this.motions = motions;
    const factor = LARGEST ** (byId('factor').value / 1000);
    byId('factor-value').value = Number(factor.toPrecision(2)).toLocaleString('en');
    if (!this.model) return;
    for (const [name, { node, nominal }] of this.nodes) {
      const motion = motions[name];
      if (motion) {
        const turn = new THREE.Vector3(...motion.rotate);
        const angle = turn.length();
        const axis = angle ? turn.divideScalar(angle) : new THREE.Vector3(1, 0, 0);
        const turned = new THREE.Quaternion().setFromAxisAngle(axis, Math.min(factor * angle, Math.PI));
        const pivot = new THREE.Vector3(...motion.pivot);
        const shift = new THREE.Vector3(...motion.shift).multiplyScalar(factor);
        if (shift.length() > 0.5 * this.size) shift.setLength(0.5 * this.size);
        const offset = pivot.clone().add(shift).sub(pivot.clone().applyQuaternion(turned));
        node.matrix.compose(offset, turned, new THREE.Vector3(1, 1, 1)).premultiply(nominal);
        node.matrixWorldNeedsUpdate = true;
      } else if (node.userData.moved) {
        node.matrix.copy(nominal);
        node.matrixWorldNeedsUpdate = true;
      }
      const moved = Boolean(motion);
      if (moved !== Boolean(node.userData.moved)) {
        node.userData.moved = moved;
        node.traverse((part) => { if (part.isMesh && !this.beams.includes(part) && part.userData.name === name) this.tint(part, moved); });
        if (node.isMesh) this.tint(node, moved);
      }
    }
    this.draw();
  }

  tint(mesh, moved) {
    mesh.material.color.setHex(moved ? 0xe07a1f : mesh.userData.colour);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.root;
    if (!width || !height) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  // Once a frame, however often it is asked for. Where drawing is slow (no graphics card) it waits until the knobs rest,
  // so that spots and readings come first.
  draw() {
    if (!this.model) return;
    const now = performance.now();
    const slow = (this.cost ?? 0) > SLOW;
    if (this.waiting && !slow) return;
    this.asked ??= now;
    clearTimeout(this.timer);
    this.waiting = true;
    const rest = slow ? Math.max(0, Math.min(REST, this.asked + LATEST - now)) : 0;
    this.timer = setTimeout(() => requestAnimationFrame(() => this.render()), rest);
  }

  render() {
    this.waiting = false;
    this.asked = undefined;
    const began = performance.now();
    this.renderer.render(this.world, this.camera);
    if (this.card) return;
    // browsers take finish() for flush(): only a pixel that is read waits until the work is done
    const context = this.renderer.getContext();
    context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, this.pixel);
    this.cost = performance.now() - began;
  }

  // where a body stands now, world, metres; for whoever looks
  position(name) {
    const found = this.nodes.get(name);
    if (!found) return null;
    found.node.updateWorldMatrix(true, false);
    return new THREE.Vector3().setFromMatrixPosition(found.node.matrixWorld).toArray();
  }
}
