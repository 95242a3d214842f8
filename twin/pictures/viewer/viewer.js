(() => {
  'use strict';
  const root = document.getElementById('viewer');
  const fallback = document.getElementById('fallback');
  const view = root.querySelector('.viewer-view');
  const slider = root.querySelector('input[type=range]');
  const output = root.querySelector('output');
  const light = root.querySelector('input[type=checkbox]');
  const FIRST_SHARE = 0.05;  // of the scene's size, by which the largest motion is drawn at first
  const LAST_SHARE = 0.4;    // and at the slider's end
  const TINTED = 12;         // if more bodies move than that, as in heat, none is told apart by its colour

  const supported = () => {
    try {
      return typeof DecompressionStream === 'function' && !!document.createElement('canvas').getContext('webgl2');
    } catch {
      return false;
    }
  };

  const unpacked = (id) => {
    const text = document.getElementById(id).textContent;
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip')));
  };

  const start = async () => {
    const script = document.createElement('script');
    script.textContent = await unpacked('viewer-library').text();
    document.head.append(script);
    const glb = await unpacked('viewer-scene').arrayBuffer();
    const scene = await new THREE.GLTFLoader().parseAsync(glb, '');
    show(scene.scene, scene.scene.userData.motions ?? {});
  };

  const show = (model, told) => {
    const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    view.append(renderer.domElement);
    const canvas = renderer.domElement;
    const scene = new THREE.Scene();
    scene.add(model, new THREE.HemisphereLight(0xffffff, 0x8890a0, 2.4));
    for (const [x, y, z, strength] of [[2, -3, 4, 2.2], [-4, 2, -1, 1.0]]) {
      const lamp = new THREE.DirectionalLight(0xffffff, strength);
      lamp.position.set(x, y, z);
      scene.add(lamp);
    }

    const moved = [];
    const beams = [];
    model.traverse((node) => {
      const name = node.userData.name ?? node.name;
      if (name.startsWith('light/')) beams.push(node);
      // without surroundings to reflect, metal is black
      if (node.isMesh) node.material.metalness = 0;
      if (name in told) {
        const { nominal, rotate, shift, pivot } = told[name];
        const turn = new THREE.Vector3(...rotate);
        moved.push({
          node, turn, angle: turn.length(), shift: new THREE.Vector3(...shift), pivot: new THREE.Vector3(...pivot),
          nominal: new THREE.Matrix4().fromArray(nominal),
        });
        node.matrixAutoUpdate = false;
      }
    });
    const box = new THREE.Box3();
    const measured = () => {
      model.updateMatrixWorld(true);
      box.makeEmpty();
      model.traverse((node) => { if (node.isMesh && !beams.includes(node)) box.expandByObject(node); });
      return box.getSize(new THREE.Vector3()).length();
    };

    const place = (factor) => {
      for (const { node, turn, angle, shift, pivot, nominal } of moved) {
        const axis = angle ? turn.clone().divideScalar(angle) : new THREE.Vector3(1, 0, 0);
        const turned = new THREE.Quaternion().setFromAxisAngle(axis, factor * angle);
        const offset = pivot.clone().addScaledVector(shift, factor).sub(pivot.clone().applyQuaternion(turned));
        node.matrix.compose(offset, turned, new THREE.Vector3(1, 1, 1)).premultiply(nominal);
        node.matrixWorldNeedsUpdate = true;
      }
      model.updateMatrixWorld(true);
    };

    // where the moved bodies stand as designed, and how far their farthest points go
    place(0);
    const size = measured();
    const nominalAt = new Map();
    let farthest = 0;
    for (const { node } of moved) {
      node.traverse((part) => {
        if (part.isMesh && !nominalAt.has(part)) nominalAt.set(part, part.matrixWorld.clone());
      });
    }
    place(1);
    for (const [part, matrix] of nominalAt) {
      part.geometry.computeBoundingBox();
      const { min, max } = part.geometry.boundingBox;
      for (let corner = 0; corner < 8; corner += 1) {
        const point = new THREE.Vector3(corner & 1 ? max.x : min.x, corner & 2 ? max.y : min.y, corner & 4 ? max.z : min.z);
        farthest = Math.max(farthest, point.clone().applyMatrix4(part.matrixWorld).distanceTo(point.applyMatrix4(matrix)));
      }
    }
    if (moved.length <= TINTED) {
      for (const [part, matrix] of nominalAt) {
        const edges = new THREE.LineSegments(
          new THREE.EdgesGeometry(part.geometry, 30), new THREE.LineBasicMaterial({ color: 0x8a929c }));
        edges.matrixAutoUpdate = false;
        edges.matrix.copy(matrix);
        scene.add(edges);
        part.material = part.material.clone();
        part.material.color.set(0xe07a1f);
      }
    }

    const camera = new THREE.PerspectiveCamera(32, 1, size * 0.001, size * 20);
    camera.up.set(0, 0, 1);
    const controls = new THREE.OrbitControls(camera, canvas);
    canvas.style.touchAction = 'pan-y';
    // the wheel belongs to the page until somebody takes hold of the view
    controls.enableZoom = false;
    canvas.addEventListener('pointerdown', () => { controls.enableZoom = true; });
    canvas.addEventListener('pointerleave', () => { controls.enableZoom = false; });
    const middle = box.getCenter(new THREE.Vector3());
    const home = () => {
      const toward = new THREE.Vector3(0.35, -1.15, 0.55).normalize();
      const right = new THREE.Vector3().crossVectors(camera.up, toward).normalize();
      const up = new THREE.Vector3().crossVectors(toward, right);
      const slope = Math.tan(camera.fov * Math.PI / 360);
      let distance = 0;
      for (let corner = 0; corner < 8; corner += 1) {
        const { min, max } = box;
        const point = new THREE.Vector3(corner & 1 ? max.x : min.x, corner & 2 ? max.y : min.y, corner & 4 ? max.z : min.z);
        point.sub(middle);
        const wide = Math.max(Math.abs(point.dot(up)), Math.abs(point.dot(right)) / camera.aspect);
        distance = Math.max(distance, point.dot(toward) + wide / slope);
      }
      camera.position.copy(middle).addScaledVector(toward, 1.08 * distance);
      controls.target.copy(middle);
      controls.update();
    };
    const draw = () => renderer.render(scene, camera);
    const resize = () => {
      const { clientWidth: width, clientHeight: height } = view;
      if (!width || !height) return;
      renderer.setSize(width, height);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      draw();
    };

    const last = farthest ? Math.max(1, LAST_SHARE * size / farthest) : 1;
    const first = farthest ? Math.max(1, FIRST_SHARE * size / farthest) : 1;
    const factor = () => last ** (slider.value / slider.max);
    const exaggerate = () => {
      place(factor());
      const rounded = Number(factor().toPrecision(2));
      output.value = rounded.toLocaleString('en').replaceAll(',', '\u202f');
      draw();
    };
    slider.disabled = last === 1;
    slider.parentElement.hidden = !moved.length;
    root.querySelector('.caption span').hidden = !moved.length;
    slider.value = last > 1 ? Math.round(slider.max * Math.log(first) / Math.log(last)) : 0;
    slider.addEventListener('input', exaggerate);
    light.addEventListener('change', () => {
      for (const beam of beams) beam.visible = light.checked;
      draw();
    });
    root.querySelector('button').addEventListener('click', home);
    controls.addEventListener('change', draw);
    root.hidden = false;
    new ResizeObserver(resize).observe(view);
    resize();
    home();
    exaggerate();
    // the drawing that stood in for the view goes to what is folded about the light path
    const folded = document.getElementById('light');
    if (folded) folded.after(fallback);
    else fallback.hidden = true;
    root.dataset.ready = 'yes';
  };

  if (supported()) start();
})();
