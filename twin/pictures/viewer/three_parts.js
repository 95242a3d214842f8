// What viewer.js uses of three.js. three.min.js is made of it, in an empty folder with this file:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three_parts.js --bundle --minify --format=iife --global-name=THREE --legal-comments=eof --outfile=three.min.js
export {
  Box3, DirectionalLight, EdgesGeometry, HemisphereLight, LineBasicMaterial, LineSegments, Matrix4, PerspectiveCamera,
  Quaternion, Scene, Vector3, WebGLRenderer,
} from 'three';
export { OrbitControls } from 'three/addons/controls/OrbitControls.js';
export { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
