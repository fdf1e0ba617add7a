/**
 * three.js, the parts that the page of `lunargr view` uses
 * @license MIT, Copyright (c) 2010-2026 three.js authors; see LICENSE.three.txt
 */
export {
  BufferAttribute, BufferGeometry, Camera, ClampToEdgeWrapping, DataArrayTexture, DataTexture, DataUtils, FloatType,
  GLSL3, HalfFloatType, LinearFilter, LinearMipmapLinearFilter, Mesh, NearestFilter, OrthographicCamera,
  PerspectiveCamera, PlaneGeometry, RGBAFormat, RGFormat, RawShaderMaterial, RedFormat, Scene, UnsignedByteType,
  Vector2, Vector3, Vector4, WebGLRenderTarget, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
